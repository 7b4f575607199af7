"""Image quality (PSNR, SSIM, LPIPS), pose errors, and evaluation on test views."""
