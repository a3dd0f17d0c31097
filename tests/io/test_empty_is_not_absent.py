"""What is given and empty is not taken for what was not given."""

from __future__ import annotations

import pytest

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.rig import read_rig
from rgbd_calib.pipeline.checked_views import reference_of
from rgbd_calib.pipeline.config import Config


def test_a_frame_without_a_name(run, tiny, tmp_path):
    outcome = run("fuse", tiny.recording, "--rig", tiny.rig_path, "--frame", "", "-o", tmp_path / "a.ply")
    assert outcome.status == 2 and list(tmp_path.iterdir()) == []


def test_a_reference_without_a_name(tiny, tmp_path):
    with pytest.raises(ConfigError, match="reference: ''"):
        reference_of(Config(reference=""), ["C1", "C2"])
    text = tiny.rig_path.read_text()
    (tmp_path / "rig.yaml").write_text(text.replace("reference: C1", "reference: ''"))
    with pytest.raises(ConfigError, match="reference: '' seen"):
        read_rig(tmp_path / "rig.yaml")


def test_markers_of_no_size(run, tmp_path):
    args = ("board", "--type", "charuco", "--square", "0.03", "--marker", "0", "-o", tmp_path / "a.pdf")
    assert run(*args).status == 2 and list(tmp_path.iterdir()) == []
