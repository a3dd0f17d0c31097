"""The rig file as JSON: the same keys, for programs without a YAML reader. Nothing is lost; null stands for NaN."""

from __future__ import annotations

from rgbd_calib.io.exports.common import Export, Options
from rgbd_calib.io.plain import to_json
from rgbd_calib.io.rig import rig_data
from rgbd_calib.types import Rig


def export(rig: Rig, options: Options) -> Export:
    """One JSON file."""
    return Export({"": to_json(rig_data(rig), indent=1, ensure_ascii=False) + "\n"})
