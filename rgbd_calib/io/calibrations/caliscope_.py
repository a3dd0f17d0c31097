"""TOML of caliscope (`[cameras.0]`, camera_array.toml) and of Anipose (`[cam_0]`): OpenCV's lens, rotation vectors.

rotation and translation take the world's points to the camera (OpenCV's rvec and tvec).
"""

from __future__ import annotations

from rgbd_calib.errors import ConfigError
from rgbd_calib.geometry import se3
from rgbd_calib.io.calibrations.common import (
    Document,
    FoundCalibration,
    FoundCamera,
    lens_of_matrix,
    matrix,
    needed,
    numbers,
    rigid_of_vectors,
)


def recognises(document: Document) -> bool:
    return document.path.suffix.lower() == ".toml" and any("matrix" in own for own in _cameras(document).values())


def read(document: Document) -> FoundCalibration:
    path, notes, cameras = document.path, [], {}
    anipose = "cameras" not in document.tree
    for key, own in _cameras(document).items():
        name = str(own.get("name", key))
        if "matrix" not in own:
            notes.append(f"{name}: without a camera matrix, not used")
            continue
        if own.get("rotation_count"):
            raise ConfigError(
                f"{path}: {name}: rotation_count {own['rotation_count']} seen: its images are turned before use. Turn the "
                "video, set rotation_count = 0 and calibrate again"
            )
        K = matrix(path, f"{name}.matrix", own["matrix"], 3, 3)
        distortion = numbers(path, f"{name}.distortions", needed(path, name, own, "distortions"))
        found = lens_of_matrix(path, name, document.need_size(own.get("size")), K, distortion, bool(own.get("fisheye")))
        pose = None
        if "rotation" in own and "translation" in own:
            pose = se3.inverse(rigid_of_vectors(path, f"{name}.rotation", own["rotation"], own["translation"]))
        cameras[name] = FoundCamera(found, pose)
    if anipose:
        notes.append("Anipose does not say the unit of translations; metres are assumed")
    return FoundCalibration("Anipose calibration" if anipose else "caliscope camera array", cameras, tuple(notes))


def _cameras(document: Document) -> dict[str, dict[str, object]]:
    named = document.tree.get("cameras")
    if isinstance(named, dict):
        return {f"cam_{key}" if key.isdigit() else key: own for key, own in named.items() if isinstance(own, dict)}
    return {
        key: own for key, own in document.tree.items() if key.startswith(("cam", "int_cam")) and isinstance(own, dict)
    }
