"""`rgbd-calib cache`: where detections are kept."""

from __future__ import annotations

import click

from rgbd_calib.cli.options import say, show


@click.command
@click.option("--clear", is_flag=True, help="Delete all entries.")
def command(clear: bool) -> None:
    """Say where the boards found in images are kept, how many there are and how much room they take.

    Every command that looks for boards keeps what it found, by the content of the image and of its depth, the board, the
    settings and the program's version, and takes it from there the next time; an interrupted one resumes. The
    folder is RGBD_CALIB_CACHE, else rgbd-calib below XDG_CACHE_HOME (~/.cache). It keeps itself below a limit by
    dropping what was not used for longest, and may be deleted at any time.
    """
    from rgbd_calib.io.cache import LIMIT_BYTES, FileCache, default_folder

    files = FileCache(default_folder(), say)
    if clear:
        files.prune(0)
    entries, size = files.usage()
    show(f"{files.folder}: {entries} entries, {size / 2**20:.1f} of {LIMIT_BYTES / 2**20:.0f} MiB")
