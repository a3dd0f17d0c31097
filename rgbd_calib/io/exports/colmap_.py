"""COLMAP's text model: one image a camera, and the rig itself; OPENCV, FULL_OPENCV (k3 to k6) or OPENCV_FISHEYE.

The centre of COLMAP's top left pixel is (0.5, 0.5), so cx and cy are larger by 0.5. COLMAP 3.11 and older read cameras,
images and points; since 3.12 it reads rigs.txt and frames.txt too, where the reference camera is the rig's frame.
"""

from __future__ import annotations

from rgbd_calib.geometry import se3, so3
from rgbd_calib.geometry.camera import Intrinsics
from rgbd_calib.geometry.so3 import FloatArray
from rgbd_calib.io.exports.common import Export, FormatLens, Options, bias_note, with_carried_lenses
from rgbd_calib.types import Rig

LENSES = (
    FormatLens("opencv", 4, "OPENCV"),
    FormatLens("opencv", 8, "FULL_OPENCV"),
    FormatLens("kannala_brandt", 4, "OPENCV_FISHEYE"),
)


def export(rig: Rig, options: Options) -> Export:
    """A folder of cameras.txt, images.txt, points3D.txt (empty), rigs.txt and frames.txt."""
    rig, refitted = with_carried_lenses(rig, "COLMAP", LENSES, options.max_px)
    image_names = options.image_names(rig)
    number = {name: i for i, name in enumerate(rig.cameras, 1)}
    T_world_ref = rig.cameras[rig.reference].T_world_color
    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then POINTS2D[], here none"]
    sensors, data_ids = [], []
    for name, camera in rig.cameras.items():
        i = number[name]
        T_color_world = se3.inverse(camera.T_world_color)
        cameras.append(f"{i} {_model(camera.intrinsics)}")
        images += [f"{i} {_pose(T_color_world)} {i} {image_names[name]}", ""]
        if name != rig.reference:
            sensors.append(f"CAMERA {i} 1 {_pose(T_color_world @ T_world_ref)}")
        data_ids.append(f"CAMERA {i} {i}")
    rigs = [
        "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[] as (SENSOR_TYPE, SENSOR_ID, HAS_POSE, pose)",
        " ".join([f"1 {len(number)} CAMERA {number[rig.reference]}", *sensors]),
    ]
    frames = [
        "# FRAME_ID, RIG_ID, RIG_FROM_WORLD pose, NUM_DATA_IDS, DATA_IDS[] as (SENSOR_TYPE, SENSOR_ID, DATA_ID)",
        " ".join([f"1 1 {_pose(se3.inverse(T_world_ref))} {len(number)}", *data_ids]),
    ]
    points = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    tables = {"cameras": cameras, "images": images, "points3D": points, "rigs": rigs, "frames": frames}
    notes = (f"image names are {next(iter(image_names.values()))} and so on; change them with --image-name",)
    files = {f"{name}.txt": "\n".join(lines) + "\n" for name, lines in tables.items()}
    return Export(files, refitted + notes + bias_note(rig, "COLMAP"))


def _model(lens: Intrinsics) -> str:
    model, own = "OPENCV", [*lens.distortion, *(0.0,) * (8 - len(lens.distortion))][:8]
    if lens.model == "kannala_brandt":
        model, own = "OPENCV_FISHEYE", [*lens.distortion]
    elif any(own[4:]):
        model = "FULL_OPENCV"
    else:
        own = own[:4]
    values = [lens.fx, lens.fy, lens.cx + 0.5, lens.cy + 0.5, *own]
    return " ".join([model, str(lens.width), str(lens.height), *map(repr, values)])


def _pose(T: FloatArray) -> str:
    return " ".join(repr(float(value)) for value in (*so3.quaternion_wxyz(T[:3, :3]), *T[:3, 3]))
