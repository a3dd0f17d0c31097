"""A small web page for a tablet at the board: live pictures, detected corners, coverage, and what is missing."""

from __future__ import annotations

from importlib import resources
from typing import Any

import cv2
import numpy as np
from flask import Flask, Response, abort, request

from rgbd_calib.capture.expected_error import ErrorCourse
from rgbd_calib.capture.guide import Guide, GuideState
from rgbd_calib.errors import ConfigError
from rgbd_calib.io.plain import to_json
from rgbd_calib.io.serving import LOOPBACK, LocalServer
from rgbd_calib.sensors.rig import SensorRig
from rgbd_calib.views.coverage import CameraCoverage
from rgbd_calib.views.range_coverage import RangeCoverage

DEFAULT_PORT = 8765
_JPEG_QUALITY = 75


def parse_address(text: str) -> tuple[str, int]:
    """(host, port) of `PORT` or `HOST:PORT`; the host is the loopback unless it is given.

    Raises
    ------
    ConfigError
        Not a port.
    """
    host, _, port = text.rpartition(":")
    if not port.isdigit() or int(port) > 65535:
        raise ConfigError(f"--preview {text}: PORT or HOST:PORT needed, such as 8765 or 0.0.0.0:8765")
    return host.strip("[]") or LOOPBACK, int(port)


def preview_server(guide: Guide, rig: SensorRig, host: str = LOOPBACK, port: int = DEFAULT_PORT) -> LocalServer:
    """The page, to be used as a context manager.

    Raises
    ------
    ConfigError
        The port is taken.
    """
    return LocalServer(_app(guide, rig).wsgi_app, host, port, "--preview")


def state_json(state: GuideState) -> dict[str, Any]:
    """The state as the page wants it."""
    coverage = state.coverage
    return {
        "advice": state.advice,
        "frame_sets": state.frame_sets,
        "look": state.look,
        "events": list(state.events),
        "enough": state.enough,
        "missing": list(coverage.missing) if coverage else [],
        "next": state.next,
        "error": _error_json(state.error) if state.error else None,
        "common_frames": [[a, b, n] for (a, b), n in coverage.common_frames.items()] if coverage else [],
        "cameras": {
            camera: {
                "live": now.live,
                "corners_px": np.round(now.corners_px, 1).tolist(),
                "coverage": _coverage_json(coverage.cameras[camera])
                if coverage and camera in coverage.cameras
                else None,
                "ranges": _ranges_json(state.ranges[camera]) if camera in state.ranges else None,
            }
            for camera, now in state.cameras.items()
        },
    }


def _coverage_json(coverage: CameraCoverage) -> dict[str, Any]:
    return {
        "views": coverage.views,
        "regions": coverage.regions.tolist(),
        "tilted": int(coverage.tilts[1:].sum()),
        "nearest_m": round(coverage.nearest_m, 2),
        "farthest_m": round(coverage.farthest_m, 2),
    }


def _error_json(error: ErrorCourse) -> dict[str, Any]:
    return {
        "history": error.history,
        "until_mm": error.until_mm,
        "reached": error.reached,
        "why": error.distrust or error.refusal,
    }


def _ranges_json(own: RangeCoverage) -> dict[str, Any]:
    return {"labels": own.labels, "counts": own.counts.tolist(), "empty": own.empty}


def _app(guide: Guide, rig: SensorRig) -> Flask:
    app = Flask("rgbd-calib")
    page = resources.files("rgbd_calib.capture").joinpath("preview.html").read_text(encoding="utf-8")

    @app.get("/")
    def show_page() -> Response:
        return Response(page, mimetype="text/html")

    @app.get("/state.json")
    def show_state() -> Response:
        return Response(to_json(state_json(guide.state())), mimetype="application/json")

    @app.get("/camera/<camera>.jpg")
    def show_picture(camera: str) -> Response:
        if camera not in rig.cameras:
            abort(404)
        rgb = guide.picture(camera, request.args.get("look", 0, int))
        if rgb is None:
            pairs = rig.reader(camera).pairs()
            rgb = pairs[-1].color.pixels if pairs else np.zeros((480, 640, 3), np.uint8)
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()
        return Response(jpeg, mimetype="image/jpeg")

    return app
