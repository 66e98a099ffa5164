"""PSNR, SSIM and ST-LPIPS; see :mod:`hvf.models.image_quality`, where training has them from."""

from hvf.models.image_quality import Measure, image_psnr, perceptual_distance, psnr, ssim

__all__ = ["Measure", "image_psnr", "perceptual_distance", "psnr", "ssim"]
