"""mrcal's .cameramodel, one file a camera: OPENCV4, 5, 8 or 12, the same lenses and meaning of pixels as here.

`extrinsics` (rt_cam_ref in newer versions, which read both) take points of the world to the camera: a rotation vector and a
translation. https://mrcal.secretsauce.net/cameramodels.html
"""

from __future__ import annotations

from rgbd_calib.geometry import se3, so3
from rgbd_calib.io.exports.common import Export, FormatLens, Options, bias_note, with_carried_lenses
from rgbd_calib.types import Rig, RigCamera

LENSES = tuple(FormatLens("opencv", n, f"LENSMODEL_OPENCV{n}") for n in (4, 5, 8, 12))


def export(rig: Rig, options: Options) -> Export:
    """A folder of NAME.cameramodel; raises ConfigError for a lens that no model of OpenCV comes near."""
    rig, refitted = with_carried_lenses(rig, "mrcal", LENSES, options.max_px)
    files = {f"{name}.cameramodel": _model(camera) for name, camera in rig.cameras.items()}
    return Export(files, (*refitted, *bias_note(rig, "mrcal")))


def _model(camera: RigCamera) -> str:
    lens, T = camera.intrinsics, se3.inverse(camera.T_world_color)
    own = next(each for each in LENSES if each.holds(lens))
    distortion = [*lens.distortion, *(0.0,) * own.n][: own.n]
    values = {
        "lensmodel": own.name,
        "intrinsics": [lens.fx, lens.fy, lens.cx, lens.cy, *distortion],
        "extrinsics": [*so3.log(T[:3, :3]).tolist(), *T[:3, 3].tolist()],
        "imagersize": [lens.width, lens.height],
    }
    return "{\n" + "".join(f"    {key!r}: {value!r},\n" for key, value in values.items()) + "}\n"
