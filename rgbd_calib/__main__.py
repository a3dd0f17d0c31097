"""`python -m rgbd_calib` is `rgbd-calib`."""

from rgbd_calib.cli.main import main

main()
