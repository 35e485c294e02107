"""The figures of quality inside a mask, pooled over frames."""
import cv2
import numpy as np


def high(image):
    x = image.astype(np.float32)
    return x - cv2.GaussianBlur(x, (0, 0), 8.0)


def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def ssim_map(a, b):
    blur = lambda x: cv2.GaussianBlur(x, (11, 11), 1.5)
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
    return (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2))


def errors(truth, image, mask, truth_high=None, truth_gray=None):
    """Sums over the mask: pixels, squared texture error, squared error (per channel mean), SSIM."""
    th = high(truth) if truth_high is None else truth_high
    tg = gray(truth) if truth_gray is None else truth_gray
    texture = ((high(image) - th)[mask] ** 2).mean(-1).sum(dtype=np.float64)
    plain = ((image.astype(np.float32) - truth.astype(np.float32))[mask] ** 2).mean(-1).sum(dtype=np.float64)
    return np.array([mask.sum(), texture, plain, ssim_map(gray(image), tg)[mask].sum(dtype=np.float64)], np.float64)


def psnr(mse):
    return float(10 * np.log10(255 ** 2 / mse)) if mse > 0 else float("inf")


def summary(rows):
    n, texture, plain, ssim = np.sum(rows, 0)
    if n == 0:
        return dict(texture_psnr=None, ssim=None, plain_psnr=None)
    return dict(texture_psnr=psnr(texture / n), ssim=ssim / n, plain_psnr=psnr(plain / n))
