"""A board that is carried before cameras that run free: its motion is the structure, and their clocks are unknowns.

The bundle of :mod:`rgbd_calib.rig.bundle` has a pose of the board for each frame. Here the poses of all views are places on one
spline (:mod:`rgbd_calib.geometry.spline`), each at its own instant, so that frames need not coincide, and what the cameras'
stamps mean can be estimated. The derivative of a row by the pose of its view is what it always was; the chain rule makes of it
the derivative by four knots and, by the board's velocity, by the clock:

    r(pose(t)):     dr/dknots = dr/dpose A(t)          dr/dt = dr/dpose twist(t)

so that the blocks of lenses, print, depth and registration act unchanged, and the rounds, weights, outliers and covariances of
the bundle too: the units that are eliminated are the windows of the spline, whose equations are banded
(:mod:`rgbd_calib.geometry.banded`). Frames in which the board stands alone before one camera, as close views, and walls are
units beside them, as ever; without a carried view, the problem is the bundle's own.
"""
