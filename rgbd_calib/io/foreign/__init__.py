"""Recordings that other programs made, read as sources of stamped pictures."""
