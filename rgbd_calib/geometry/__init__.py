"""Arrays in, arrays out: rotations, rigid motions, cameras, planes. No files, no camera names.

Conventions
-----------
- `T_a_b` maps coordinates of frame b into frame a: ``p_a = T_a_b @ p_b``; `R_a_b` is its rotation and
  `t_a_b` the origin of b written in a. Inner names cancel in products: ``T_a_c = T_a_b @ T_b_c``.
- Camera frames: x right, y down, z forward. Pixel (0, 0) is the centre of the top left pixel.
- Metres, radians, seconds, pixels. Quaternions are (w, x, y, z).
- A perturbation of a pose is a left one, xi = (phi, rho) in R^6, rotation vector first:
  ``T(xi) = [Exp(phi), rho; 0, 1] @ T``, so that a point moves by phi x p + rho in the outer frame.
"""
