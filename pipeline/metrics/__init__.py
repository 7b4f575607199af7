"""Image quality (PSNR, SSIM, FLIP, LPIPS), pose errors, and evaluation on test views."""
