"""A folder of small results, each under the hash of what it was made from: may be deleted at any time, never in the way.

One file an entry, written beside its place and renamed into it, with a checksum: a kill, a full disk or a second process
leaves whole entries or none. Nothing in an entry is ever executed. (diskcache would store the same in SQLite; it has had
no release since 2023, and an open CVE-2025-69872 for the pickles that it reads.)
"""

from __future__ import annotations

import hashlib
import os
import re
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

MAGIC = b"rgbd-calib cache 1\n"
LIMIT_BYTES = 256 * 2**20
"""Of all entries together: corners of some 60,000 images."""
MAX_ENTRY_BYTES = 2**20
"""A file that is larger is no entry: a view of the largest board has some ten thousand corners of 40 bytes."""
BLOCK_BYTES = 4096
"""A small file takes this much of the disk."""
CHECK_EVERY = 4096
"""Entries written between two looks at the folder's size."""
LEFTOVER_S = 3600.0
"""A temporary file this old is of a process that was killed."""
_PARTIAL = ".partial-"
_FOLDER, _ENTRY = re.compile("[0-9a-f]{2}"), re.compile("[0-9a-f]{64}")
"""Names of our own: RGBD_CALIB_CACHE may name a folder that holds files of others."""


def default_folder() -> Path:
    """RGBD_CALIB_CACHE, else rgbd-calib in the system's place for such things (XDG_CACHE_HOME, ~/.cache)."""
    from platformdirs import user_cache_path

    own = os.environ.get("RGBD_CALIB_CACHE")
    return Path(own).absolute() if own else user_cache_path("rgbd-calib", appauthor=False)


class FileCache:
    """Bytes by key; whatever is wrong with the folder is said once, and the work goes on without it.

    Parameters
    ----------
    say : takes a sentence for the user.
    """

    def __init__(self, folder: Path, say: Callable[[str], object], limit_bytes: int = LIMIT_BYTES) -> None:
        self.folder, self.limit_bytes = folder, limit_bytes
        self._say, self._broken, self._written = say, False, 0

    def get(self, key: str) -> bytes | None:
        """The entry, or None where there is none that is whole."""
        path = self._path(key)
        try:
            status = path.stat()
            if not stat.S_ISREG(status.st_mode) or status.st_size > MAX_ENTRY_BYTES:
                return None
            raw = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._give_up(error)
            return None
        head = MAGIC + _checksum(key, raw[len(MAGIC) + 32 :])
        if not raw.startswith(head):
            return None  # the next `put` replaces it
        with suppress(OSError):  # read-only, or deleted a moment ago
            os.utime(path)  # the entries used longest ago go first
        return raw[len(head) :]

    def put(self, key: str, data: bytes) -> None:
        """Keep an entry, where the folder allows it."""
        path = self._path(key)
        if self._broken or len(data) > MAX_ENTRY_BYTES - 64:
            return
        try:
            path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(prefix=_PARTIAL, dir=path.parent)
            try:
                with os.fdopen(handle, "wb") as stream:
                    stream.write(MAGIC + _checksum(key, data) + data)
                os.replace(temporary, path)
            except BaseException:
                Path(temporary).unlink(missing_ok=True)
                raise
        except FileNotFoundError:
            return  # the folder was deleted under our hands
        except OSError as error:
            self._give_up(error)
            return
        self._written += 1
        if self._written % CHECK_EVERY == 0:
            self.prune()

    def close(self) -> None:
        """Keep the folder within its bound; nothing else needs closing."""
        if self._written:
            self.prune()

    def usage(self) -> tuple[int, int]:
        """Entries, and bytes that they take."""
        entries = list(self._entries())
        return len(entries), sum(size for _, size, _ in entries)

    def prune(self, limit_bytes: int | None = None) -> None:
        """Delete the entries used longest ago until a tenth below the limit, where it is passed."""
        limit = self.limit_bytes if limit_bytes is None else limit_bytes
        entries = sorted(self._entries())
        total = sum(size for _, size, _ in entries)
        if total <= limit:
            return
        for _, size, path in entries:
            if total <= 0.9 * limit:
                break
            try:
                if _is_entry(path):
                    path.unlink()
            except FileNotFoundError:
                pass  # another process was faster
            except OSError as error:
                self._give_up(error)
                return
            total -= size

    def _entries(self) -> Iterator[tuple[float, int, Path]]:
        """(time of last use, bytes on disk, path) of entries; deletes what killed processes left."""
        old = time.time() - LEFTOVER_S
        for folder in _listed(self.folder):
            if not _FOLDER.fullmatch(folder.name) or not folder.is_dir(follow_symlinks=False):
                continue
            for item in _listed(Path(folder.path)):
                try:
                    status = item.stat(follow_symlinks=False)
                    if item.name.startswith(_PARTIAL) and status.st_mtime < old:
                        os.unlink(item.path)
                except OSError:
                    continue
                if _ENTRY.fullmatch(item.name) and stat.S_ISREG(status.st_mode):
                    yield status.st_mtime, max(status.st_size, BLOCK_BYTES), Path(item.path)

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / key

    def _give_up(self, error: OSError) -> None:
        if not self._broken:
            self._say(
                f"{self.folder}: cannot be used to keep what was found ({error.strerror or error}); going on without. "
                "Delete it, or name another folder in RGBD_CALIB_CACHE"
            )
        self._broken = True


def _is_entry(path: Path) -> bool:
    """True where the file begins as one of ours."""
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def _checksum(key: str, data: bytes) -> bytes:
    return hashlib.sha256(key.encode() + data).digest()


def _listed(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except OSError:
        return []
