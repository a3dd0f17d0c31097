#!/usr/bin/env python3
"""Pictures of the README from a report: its top in headless Chromium, and the clouds before and after.

After `scripts/demo demo`:

    .venv/bin/python scripts/report_pictures.py demo/report/index.html scripts/figures
"""

from __future__ import annotations

import base64
import io
import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait

COLORS = 255
"""Of the palette: enough for a page, and the files stay below 200 kB."""


@contextmanager
def chromium(width: int, height: int, *arguments: str) -> Iterator[webdriver.Chrome]:
    """A headless browser whose page has this size, px."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", *arguments):
        options.add_argument(argument)
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        yield driver
    finally:
        driver.quit()


def screenshot(page: Path, width: int, height: int) -> Image.Image:
    """The top of the page, drawn."""
    with chromium(width, 1000, "--enable-unsafe-swiftshader") as driver:
        driver.get(page.resolve().as_uri())
        WebDriverWait(driver, 300).until(lambda d: d.execute_script("return document.body.dataset.drawn") == "yes")
        clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": 1}
        shot = driver.execute_cdp_cmd("Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip})
    return Image.open(io.BytesIO(base64.b64decode(shot["data"]))).convert("RGB")


def clouds(page: Path) -> Image.Image:
    """The first two pairs of pictures, before on the left, after on the right."""
    found = re.findall(r'src="data:image/jpeg;base64,([^"]+)"', page.read_text(encoding="utf-8"))[:4]
    pictures = [Image.open(io.BytesIO(base64.b64decode(data))) for data in found]
    width = pictures[0].width
    sheet = Image.new("RGB", (2 * width + 8, sum(p.height for p in pictures[::2]) + 8), (160, 160, 160))
    top = 0
    for before, after in zip(pictures[::2], pictures[1::2], strict=True):
        sheet.paste(before, (0, top))
        sheet.paste(after, (width + 8, top))
        top += before.height + 8
    return sheet.resize((sheet.width * 5 // 8, sheet.height * 5 // 8), Image.Resampling.LANCZOS)


def main() -> None:
    page, out = Path(sys.argv[1]), Path(sys.argv[2])
    out.mkdir(parents=True, exist_ok=True)
    drawn = {
        "report_desktop": screenshot(page, 1280, 1560).resize((960, 1170), Image.Resampling.LANCZOS),
        "report_phone": screenshot(page, 390, 1500),
        "clouds": clouds(page),
    }
    for name, picture in drawn.items():
        path = out / f"{name}.png"
        picture.quantize(COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)
        print(f"{path}: {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
