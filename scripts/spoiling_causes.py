"""Words that name the cause of each spoiling, as regular expressions; for scripts/study_silent_failures.py and its test."""

CAUSES: dict[str, str] = {}
