"""A rig and its clouds in Rerun: cameras with their frusta and images, clouds by camera, one world.

Rerun's pinholes have no distortion: frusta and images are drawn with K alone, clouds with the whole lens model. Its own
servers listen on all networks and ask nobody for a name, so its viewers are started bound to this computer, and data go
to a browser from our own server.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rgbd_calib.errors import ConfigError
from rgbd_calib.io.images import MAX_BYTES
from rgbd_calib.io.reading import read_bytes
from rgbd_calib.report.splat import camera_color
from rgbd_calib.types import Rig

if TYPE_CHECKING:
    from rgbd_calib.geometry.so3 import FloatArray

TIMELINE = "frame"
WEB_PORT, DATA_PORT = 9090, 9091
_START_S = 20.0
_RERUN = "import sys; from rerun_cli.__main__ import main; sys.exit(main())"  # `python -m rerun_cli` drops the status
_PNG = b"\x89PNG"


def rerun() -> Any:
    """The module `rerun`, or a ConfigError that says how to install it."""
    try:
        import rerun as rr
    except ImportError as error:
        raise ConfigError(
            f"view: the viewer Rerun is not installed ({error}); `pip install rgbd-calib[view]` (about 160 MB). "
            "Without it, `rgbd-calib fuse --image` makes pictures, and any program shows its .ply"
        ) from error
    return rr


def log_rig(stream: Any, rig: Rig, frustum_m: float = 0.15) -> None:
    """Log every camera: pose, frustum with its image plane at `frustum_m` metres, name, colour."""
    rr = rerun()
    stream.log("world", rr.ViewCoordinates.RDF, static=True)
    for i, (name, camera) in enumerate(rig.cameras.items()):
        lens, T = camera.intrinsics, camera.T_world_color
        path = _path(name)
        stream.log(path, rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]), static=True)
        pinhole = rr.Pinhole(
            image_from_camera=lens.K,
            resolution=[lens.width, lens.height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=frustum_m,
            color=camera_color(i),
        )
        stream.log([*path, "image"], pinhole, static=True)
        stream.log([*path, "name"], rr.Points3D([[0, 0, 0]], colors=[camera_color(i)], labels=[name]), static=True)


def log_frame(
    stream: Any,
    number: int,
    clouds: Mapping[str, tuple[FloatArray, np.ndarray]],
    images: Mapping[str, Path],
) -> None:
    """Log one instant: points (n, 3), metres, in the world, with colours (n, 3), and colour images, PNG or JPEG files."""
    rr = rerun()
    stream.set_time(TIMELINE, sequence=number)
    for camera, (points_m, colors) in clouds.items():
        stream.log(["world", "clouds", camera], rr.Points3D(points_m.astype(np.float32), colors=colors, radii=-1.0))
    for camera, file in images.items():
        data = read_bytes(file, MAX_BYTES)
        media = "image/png" if data.startswith(_PNG) else "image/jpeg"
        stream.log([*_path(camera), "image"], rr.EncodedImage(contents=data, media_type=media))


def show(data: bytes) -> None:
    """Open the viewer's window on the .rrd `data`, and wait until it is closed.

    Raises
    ------
    ConfigError
        There is no display, or the viewer fails otherwise.
    """
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rig.rrd"
        file.write_bytes(data)
        with _viewer("--port", "auto", str(file)) as process:
            status = process.wait()
    if status != 0:
        raise ConfigError(
            f"view: the viewer ended with status {status}. Without a display use --serve, or --save and another computer"
        )


def serve(data: bytes, say: Callable[[str], object]) -> None:
    """Serve the viewer and the .rrd `data` to a browser on this computer, until the process is interrupted.

    Raises
    ------
    ConfigError
        A port is taken.
    """
    from werkzeug.wrappers import Response

    from rgbd_calib.io.serving import LOOPBACK, LocalServer

    origin = f"http://{LOOPBACK}:{WEB_PORT}"
    headers = {"Access-Control-Allow-Origin": origin}
    answer = Response(data, mimetype="application/octet-stream", headers=headers)
    with (
        LocalServer(answer, LOOPBACK, DATA_PORT, "--serve") as server,
        _viewer("--serve-web", "--web-viewer-port", str(WEB_PORT), f"{server.url}rig.rrd") as process,
    ):
        _await_port(process)
        say(
            f"Open {origin}/?url={server.url}rig.rrd. Stop with Ctrl-C. From another computer: ssh "
            f"-L {WEB_PORT}:{LOOPBACK}:{WEB_PORT} -L {DATA_PORT}:{LOOPBACK}:{DATA_PORT} HOST"
        )
        process.wait()
    raise ConfigError("view: the viewer ended by itself. Use --save, and open the file with `rerun`")


@contextmanager
def _viewer(*args: str) -> Iterator[subprocess.Popen[bytes]]:
    """Rerun's own program, bound to this computer; it ends with the body."""
    command = [sys.executable, "-c", _RERUN, "--bind", "127.0.0.1", *args]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True) as process:
        try:
            yield process
        finally:
            with suppress(OSError):  # it starts a process of its own, so that the whole group must end
                os.killpg(process.pid, signal.SIGTERM)


def _await_port(process: subprocess.Popen[bytes]) -> None:
    end_s = time.monotonic() + _START_S
    while process.poll() is None and time.monotonic() < end_s:
        with suppress(OSError), socket.create_connection(("127.0.0.1", WEB_PORT), timeout=1):
            return
        time.sleep(0.1)
    raise ConfigError(f"--serve: the viewer does not start on port {WEB_PORT}. Is the port taken? Use --save instead")


def _path(camera: str) -> list[str]:
    return ["world", "cameras", camera]  # as parts: names may hold any character
