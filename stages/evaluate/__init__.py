"""The one evaluation (PSNR, SSIM, FLIP), the contribution of each splat, floaters, coverage.

`evaluation` compares drawings with photographs by `image_metrics`. `contribution` measures what
each splat does in the pictures, with `sh`; `rate_distortion` and `selection` decide with it what a
model can spare. `floaters` finds splats in free space, `coverage` says what the photographs miss.
"""
