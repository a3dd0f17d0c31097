"""The configurations that come with the program."""

from __future__ import annotations

import json
from pathlib import Path

from rgbd_calib.io.files import load_yaml
from rgbd_calib.pipeline.config import Config, as_plain, load_config

CONFIGS = Path(__file__).parents[2] / "configs"


def test_defaults_are_written_out_whole() -> None:
    written = load_yaml(CONFIGS / "defaults.yaml")
    assert written == json.loads(json.dumps(as_plain(Config())))  # YAML has lists, no tuples


def test_the_xtion_rig_is_a_valid_configuration() -> None:
    assert load_config(CONFIGS / "xtion4.yaml").depth_bias.max_order == 3
