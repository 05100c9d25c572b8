"""The one evaluation (PSNR, SSIM, FLIP), the contribution of each splat, floaters, coverage."""
