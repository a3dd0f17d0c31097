"""An import that was interrupted, or that found the disk full, goes on where it was."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_files import save

from rgbd_calib.errors import CalibrationError
from rgbd_calib.io.foreign import folder_writer
from rgbd_calib.io.recording import open_recording
from rgbd_calib.pipeline.import_cameras import CameraOptions
from rgbd_calib.pipeline.import_recording import ImportOptions, import_recording
from rgbd_calib.pipeline.import_sources import OpenOptions, open_source

RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (48, 64, 3), np.uint8)
DEPTH = RNG.integers(1, 9000, (48, 64), np.uint16)


def plain_folder(folder: Path, n: int = 20) -> Path:
    for i in range(n):
        save(folder / "color" / f"{i:06d}.png", np.roll(COLOR, i))
        save(folder / "depth" / f"{i:06d}.png", DEPTH + i)
    return folder


def test_an_interrupted_import_goes_on(tmp_path, monkeypatch):
    source = plain_folder(tmp_path / "scan")
    out = tmp_path / "out"
    options = ImportOptions(CameraOptions(depth_scale=0.001))
    put, count = folder_writer.ImportFolder.put, []

    def stopped(self, *args):
        count.append(1)
        if len(count) > 25:
            self.finish()
            raise KeyboardInterrupt
        return put(self, *args)

    monkeypatch.setattr(folder_writer.ImportFolder, "put", stopped)
    with pytest.raises(KeyboardInterrupt):
        import_recording([open_source(source, "C1", OpenOptions())], out, options)
    assert not out.exists() and (tmp_path / ".out.importing").is_dir()
    monkeypatch.setattr(folder_writer.ImportFolder, "put", put)
    result = import_recording([open_source(source, "C1", OpenOptions())], out, options)
    assert result.resumed == 25 and result.frames == 20
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out", "scan"]
    recording = open_recording(out)
    np.testing.assert_array_equal(recording.color("C1", "000019"), np.roll(COLOR, 19))


def test_another_import_does_not_go_on_with_it(tmp_path, monkeypatch):
    source, out = plain_folder(tmp_path / "scan", 3), tmp_path / "out"
    half = folder_writer.ImportFolder(out, {"plan": "another"})
    half.put("C1", "color", "999999", COLOR, "x")
    half.finish()
    half.close()
    options = ImportOptions(CameraOptions(depth_scale=0.001))
    result = import_recording([open_source(source, "C1", OpenOptions())], out, options)
    assert result.resumed == 0 and open_recording(out).frames == ("000000", "000001", "000002")
    (tmp_path / ".new.importing").mkdir()
    (tmp_path / ".new.importing" / "mine.txt").write_text("mine")
    with pytest.raises(Exception, match="no unfinished import"):
        import_recording([open_source(source, "C1", OpenOptions())], tmp_path / "new", options)


def test_a_full_disk_keeps_what_is_written(tmp_path, monkeypatch):
    source, out = plain_folder(tmp_path / "scan", 6), tmp_path / "out"
    options = ImportOptions(CameraOptions(depth_scale=0.001))
    write, count = Path.write_bytes, []

    def full(self, data):
        if ".importing" in str(self):
            count.append(1)
            if len(count) > 5:
                raise OSError(28, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(CalibrationError, match=r"the disk is full; .* it goes on"):
        import_recording([open_source(source, "C1", OpenOptions())], out, options)
    monkeypatch.setattr(Path, "write_bytes", write)
    assert import_recording([open_source(source, "C1", OpenOptions())], out, options).resumed > 0
