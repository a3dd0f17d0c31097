"""The rig file as JSON: the same keys, for programs without a YAML reader. Nothing is lost."""

from __future__ import annotations

import json

from rgbd_calib.io.exports.common import Export, Options
from rgbd_calib.io.files import plain
from rgbd_calib.io.rig import rig_data
from rgbd_calib.types import Rig


def export(rig: Rig, options: Options) -> Export:
    """One JSON file."""
    return Export({"": json.dumps(plain(rig_data(rig)), indent=1, ensure_ascii=False) + "\n"})
