#!/usr/bin/env python3
"""Picture of the preview page of a capture: a recording is played as cameras, and the page drawn in headless Chromium.

After `rgbd-calib simulate sim --cameras 3 --frames 16`:

    .venv/bin/python scripts/preview_picture.py sim/extrinsic docs/figures/preview.jpg [WIDTH HEIGHT]
"""

from __future__ import annotations

import io
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

from PIL import Image
from report_pictures import chromium

ESTIMATES = 2
"""Of the expected error; some regions are seen then, and some are missing."""
_LOADING_S = 2.0


def screenshot(url: str, width: int, height: int) -> Image.Image:
    with chromium(width, height, "--hide-scrollbars") as driver:
        driver.get(url)
        time.sleep(_LOADING_S)
        return Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")


def estimates(state: dict[str, Any]) -> int:
    history = state["error"]["history"]
    return history.count("→") + 1 if history else 0


def main() -> None:
    recording, out = sys.argv[1], Path(sys.argv[2])
    width, height = (int(v) for v in (*sys.argv[3:5], 1440, 900)[:2])
    with tempfile.TemporaryDirectory() as folder:
        options = ["--driver", f"replay:{recording}", "--interval", "1.1", "--settle", "0.3", "--preview", "0"]
        board = ["--board", f"{recording}/dataset.yaml", "--until-mm", "0.5"]
        command = [sys.executable, "-m", "rgbd_calib", "capture", f"{folder}/played", *options, *board]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as capture:
            assert capture.stderr is not None
            url = next(found[1] for line in capture.stderr if (found := re.search(r"preview: (http://\S+)", line)))
            while estimates(json.load(urllib.request.urlopen(f"{url}state.json"))) < ESTIMATES:
                time.sleep(0.2)
            picture = screenshot(url, width, height)
            capture.send_signal(signal.SIGINT)
            capture.communicate()
    picture.save(out, quality=85, optimize=True)
    print(f"{out}: {out.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
