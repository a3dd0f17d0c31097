"""capture.yaml: what happened while a recording was made, session by session.

It is rewritten whole at every event, so that a kill leaves the last state: a session that still says `running` was
killed.
"""

from __future__ import annotations

import threading
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from rgbd_calib.io.files import dump_yaml, load_yaml, write_text
from rgbd_calib.io.schema_base import Name, Positive, parse

FORMAT = "rgbd-calib/capture"
VERSION = 1
MAX_EVENTS = 1000
Status = Literal["running", "complete", "interrupted", "failed"]


class SessionModel(BaseModel):
    """One session; what is not read again may be anything."""

    model_config = ConfigDict(extra="allow")
    cameras: dict[Name, dict[str, Any]] | None = None


class CaptureModel(BaseModel):
    """capture.yaml."""

    model_config = ConfigDict(extra="allow")
    format: Literal["rgbd-calib/capture"]
    version: Literal[1]
    clock_zero_unix_s: Positive | None = None
    sessions: list[SessionModel] | None = None


class CaptureLog:
    """The log of one session, after those of earlier sessions of the same recording."""

    def __init__(self, folder: Path, command: str, program: str) -> None:
        self._path = folder / "capture.yaml"
        self._lock = threading.Lock()
        earlier = load_yaml(self._path) if self._path.exists() else {}
        if earlier:
            parse(CaptureModel, earlier, self._path)
        self.earlier: list[dict[str, Any]] = list(earlier.get("sessions") or [])
        now = datetime.now(timezone.utc)
        self.clock_zero_unix_s = float(earlier.get("clock_zero_unix_s") or now.timestamp())
        """Zero of all times in the recording."""
        self._session: dict[str, Any] = {
            "started": now.isoformat(timespec="milliseconds"),
            "ended": None,
            "status": "running",
            "message": None,
            "command": command,
            "program": program,
            "cameras": {},
            "counts": {},
            "events": [],
        }

    def identities(self) -> dict[str, str]:
        """{camera: serial number or USB path} of the earlier sessions."""
        known: dict[str, str] = {}
        for session in self.earlier:
            for camera, entry in (session.get("cameras") or {}).items():
                key = entry.get("serial") or entry.get("usb_path") or entry.get("uri")
                if key:
                    known[camera] = str(key)
        return known

    def set(self, **values: Any) -> None:
        """Set keys of this session and write."""
        with self._lock:
            self._session.update(values)
            self._write()

    def event(self, camera: str, text: str, at_s: float) -> None:
        """Note what happened, `at_s` seconds into the session."""
        with self._lock:
            if len(self._session["events"]) < MAX_EVENTS:
                self._session["events"].append({"at_s": round(at_s, 3), "camera": camera or None, "event": text})
            self._write()

    def end(self, status: Status, message: str | None, counts: dict[str, Any]) -> None:
        """Close the session."""
        ended = datetime.now(timezone.utc).isoformat(timespec="milliseconds")
        self.set(status=status, message=message, counts=counts, ended=ended)

    def _write(self) -> None:
        data = {
            "format": FORMAT,
            "version": VERSION,
            "clock_zero_unix_s": self.clock_zero_unix_s,
            "sessions": [*self.earlier, self._session],
        }
        write_text(self._path, dump_yaml(data))
