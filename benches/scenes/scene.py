"""The tissue of one set: a displaced height field, its albedo, wetness and wet-film slopes, all from one seed.

Scene frame: z up, tissue around z = 0, lengths in mm.  The sheet reaches HALF mm to each side."""
import pathlib

import cv2
import numpy as np

HALF = 135.0
MESH = 541            # vertices per side (0.5 mm)
TEXTURE = 8192        # albedo, 0.033 mm per texel
FILM = 2048           # film slopes, periodic
FILM_MM = 64.0


def smooth_noise(rng, side, wavelength_mm, span_mm=2 * HALF):
    """Band-limited noise of unit deviation: a random grid, enlarged with cubic weights."""
    cells = max(int(span_mm / wavelength_mm * 2), 4)
    grid = rng.standard_normal((cells + 4, cells + 4)).astype(np.float32)
    image = cv2.resize(grid, (side, side), interpolation=cv2.INTER_CUBIC)
    return image / image.std()


def periodic_noise(rng, side, low_mm, high_mm, tilt, span_mm=FILM_MM):
    """Periodic Gaussian noise with wavelengths in [low, high] mm; amplitude falls as frequency^-tilt."""
    f = np.hypot(np.fft.fftfreq(side, span_mm / side)[:, None], np.fft.rfftfreq(side, span_mm / side)[None])
    f[0, 0] = 1e9
    lo, hi = 1 / high_mm, 1 / low_mm
    gain = f ** -tilt / (1 + (f / hi) ** 8) / (1 + (lo / f) ** 8)
    white = np.fft.rfft2(rng.standard_normal((side, side)))
    image = np.fft.irfft2(white * gain, (side, side))
    return (image / image.std()).astype(np.float32)


def smoothstep(x, a, b):
    t = np.clip((x - a) / (b - a), 0, 1)
    return t * t * (3 - 2 * t)


class Scene:
    def __init__(self, seed):
        self.seed = seed
        part = lambda k: np.random.default_rng([seed, k])      # each part its own stream
        self.rng = part(0)
        self._shape()
        self.rng = part(1)
        self._film()
        self.rng = part(2)
        cache = pathlib.Path(__file__).parent / "cache" / f"albedo_{seed}.npy"
        if cache.exists():
            self.albedo = np.load(cache)
        else:
            self._texture()
            cache.parent.mkdir(exist_ok=True)
            np.save(cache, self.albedo)

    # ---- geometry -------------------------------------------------------------------------------------------
    def _shape(self):
        rng = self.rng
        axis = np.linspace(-HALF, HALF, MESH)
        x, y = np.meshgrid(axis, axis)
        z = 2.6 * smooth_noise(rng, MESH, 90) + 1.3 * smooth_noise(rng, MESH, 38) + 0.8 * smooth_noise(rng, MESH, 16)
        z += 0.14 * smooth_noise(rng, MESH, 7)
        turn = rng.uniform(0, 2 * np.pi)
        # gall bladder: a long ellipsoid half sunk in the liver
        c, s = np.cos(turn), np.sin(turn)
        gx, gy = rng.uniform(-12, 12, 2)
        u, v = (x - gx) * c + (y - gy) * s, -(x - gx) * s + (y - gy) * c
        v = v + 0.006 * u * u * np.sign(rng.uniform(-1, 1))
        q = 1 - (u / 40) ** 2 - (v / 17) ** 2
        gall = 19 * np.sqrt(np.maximum(q, 0)) - 5
        self.gall = smoothstep(gall, -3.0, 1.5).astype(np.float32)
        k = 4.0                                                   # smooth maximum keeps the crease soft
        bulge = k * np.log(np.exp(gall / k) + 1)
        # two rounder bulges beside it
        for _ in range(2):
            a = turn + np.pi / 2 + rng.uniform(-0.7, 0.7) + (np.pi if _ else 0)
            bx, by = gx + 48 * np.cos(a), gy + 48 * np.sin(a)
            r2 = ((x - bx) / rng.uniform(20, 26)) ** 2 + ((y - by) / rng.uniform(16, 22)) ** 2
            bulge = bulge + rng.uniform(7, 11) * np.exp(-r2 * r2 * 0.5 - 0.4 * r2)
        # a fold: a steep edge that leans over, so that it hides tissue behind it
        a = turn + rng.uniform(0.9, 1.3)
        n = (x * np.cos(a) + y * np.sin(a)) - 34 + 7 * np.sin((-x * np.sin(a) + y * np.cos(a)) / 21)
        lip = 9.5 * smoothstep(n, -2.2, 2.2) * np.exp(-np.maximum(n, 0) / 26)
        self.fat = smoothstep(n, 0, 5) * np.exp(-np.maximum(n, 0) / 40)
        lean = 0.35 * lip
        self.rest = np.stack([x - np.cos(a) * lean, y - np.sin(a) * lean, z + bulge + lip], -1)
        self.uv = np.stack([(x + HALF) / (2 * HALF), (y + HALF) / (2 * HALF)], -1)
        i = np.arange((MESH - 1) ** 2)
        r, col = i // (MESH - 1), i % (MESH - 1)
        b = r * MESH + col
        self.faces = np.concatenate([np.stack([b, b + 1, b + MESH], -1),
                                     np.stack([b + 1, b + MESH + 1, b + MESH], -1)]).astype(np.uint32)
        self.breath_map = 0.75 + 0.25 * np.tanh((x * np.cos(turn + 1) + y * np.sin(turn + 1)) / 45)
        self.breath_side = 0.22 * np.sin(x / 55 + 1) * np.cos(y / 60)
        self.heart_map = np.exp(-((x - 25) ** 2 + (y + 15) ** 2) / (2 * 45 ** 2))

    def vertices(self, breath_mm=0.0, heart_mm=0.0):
        """Positions and smooth normals with the tissue moved by breath and heart."""
        p = self.rest.copy()
        p[..., 2] += breath_mm * self.breath_map + heart_mm * self.heart_map
        p[..., 1] += breath_mm * self.breath_side
        p[..., 0] += heart_mm * 0.4 * self.heart_map
        du, dv = np.gradient(p, axis=1), np.gradient(p, axis=0)
        n = np.cross(du, dv)
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        return p.reshape(-1, 3).astype(np.float32), n.reshape(-1, 3).astype(np.float32)

    # ---- colour ---------------------------------------------------------------------------------------------
    def _texture(self):
        rng, side = self.rng, TEXTURE
        big = lambda image: cv2.resize(image.astype(np.float32), (side, side), interpolation=cv2.INTER_LINEAR)
        gall, fat_edge = big(self.gall), big(self.fat)
        patches = cv2.resize(smooth_noise(rng, 1024, 26), (side, side)) + 0.35 * cv2.resize(smooth_noise(rng, 2048, 5), (side, side))
        fat = np.clip(smoothstep(patches, 1.25, 1.75) * 0.8 + fat_edge * smoothstep(patches, -0.6, 0.4), 0, 1)
        del patches
        # lobules: distance to the nearest of many points, about 1.3 mm apart
        dots = np.full((side // 2, side // 2), 255, np.uint8)
        count = int((2 * HALF / 1.3) ** 2)
        dots[rng.integers(0, side // 2, count), rng.integers(0, side // 2, count)] = 0
        lobule = cv2.distanceTransform(dots, cv2.DIST_L2, 5) * (2 * 2 * HALF / side)
        lobule = cv2.resize(np.clip(lobule / 0.8, 0, 1.4), (side, side)) - 0.45
        vessels, small = self._vessels()
        tone = 0.16 * cv2.resize(smooth_noise(rng, 1024, 30), (side, side))
        tone += 0.15 * cv2.resize(smooth_noise(rng, 1024, 9), (side, side))
        tone += 0.05 * cv2.resize(smooth_noise(rng, 4096, 2.2), (side, side))
        fine = 0.035 * smooth_noise(rng, side, 0.8) + 0.035 * smooth_noise(rng, side, 0.33) + 0.03 * smooth_noise(rng, side, 0.16)
        fine -= 0.13 * lobule * (1 - 0.75 * gall)
        fine *= DETAIL
        scale = np.exp(tone + fine)
        del tone, fine, lobule
        liver, bladder, pale = (0.36, 0.095, 0.07), (0.40, 0.24, 0.15), (0.62, 0.45, 0.24)
        blood = (0.33, 0.045, 0.04)
        vein = np.clip(vessels * (0.85 - 0.2 * fat), 0, 1)
        hair = np.clip(small * 0.42, 0, 1)
        self.albedo = np.empty((side, side, 4), np.float16)
        for ch in range(3):
            value = liver[ch] * (1 - gall) + bladder[ch] * gall
            value = value * (1 - fat) + pale[ch] * fat
            value = value * scale if ch == 0 else value * (1 + (scale - 1) * 1.25)
            value = value * (1 - vein) + blood[ch] * vein * 0.75
            value = value * (1 - hair) + blood[ch] * hair
            self.albedo[..., ch] = np.clip(value, 0.01, 0.85)
        # the fourth channel: how wet, 0 (smooth film) .. 1 (bumpy film)
        wet = 0.7 * smooth_noise(rng, 1024, 26) + 0.4 * smooth_noise(rng, 1024, 11)
        self.albedo[..., 3] = cv2.resize(smoothstep(wet, -1.2, 1.3).astype(np.float32), (side, side))

    def _vessels(self):
        """Branching random walks, drawn with their width: large ones (3 mm and down) and hair-thin ones."""
        rng, side = self.rng, TEXTURE
        per_mm = side / (2 * HALF)
        large, thin = np.zeros((side, side), np.uint8), np.zeros((side, side), np.uint8)

        def grow(canvas, x, y, heading, width_mm, length_mm, depth):
            step, points, turn = 0.5, [(x, y)], 0.0
            start = width_mm
            for k in range(int(length_mm / step)):
                turn = 0.8 * turn + 0.1 * rng.standard_normal()
                heading += turn * 0.5 + 0.02 * np.sin(k * 0.13 + start)
                x, y = x + step * np.cos(heading), y + step * np.sin(heading)
                width = start * (1 - 0.6 * k * step / length_mm)
                line = np.array([points[-1], (x, y)])
                pts = np.round((line + HALF) * per_mm * 16).astype(np.int32)
                cv2.line(canvas, tuple(map(int, pts[0])), tuple(map(int, pts[1])), 255, max(1, int(round(width * per_mm))), cv2.LINE_AA, 4)
                points.append((x, y))
                if depth > 0 and rng.random() < 0.035:
                    grow(canvas, x, y, heading + rng.choice([-1, 1]) * rng.uniform(0.5, 1.1), width * rng.uniform(0.45, 0.75),
                         length_mm * rng.uniform(0.3, 0.6), depth - 1)

        for _ in range(26):
            grow(large, *rng.uniform(-HALF, HALF, 2), rng.uniform(0, 6.3), rng.choice([0.6, 0.9, 1.3, 2.0, 3.0]), rng.uniform(50, 110), 3)
        for _ in range(650):
            grow(thin, *rng.uniform(-HALF, HALF, 2), rng.uniform(0, 6.3), rng.uniform(0.1, 0.28), rng.uniform(6, 26), 2)
        large = cv2.GaussianBlur(large, (0, 0), 5).astype(np.float32) / 255
        thin = cv2.GaussianBlur(thin, (0, 0), 1.6).astype(np.float32) / 255
        return large, thin

    # ---- wet film -------------------------------------------------------------------------------------------
    def _film(self):
        """Slopes of the film: a coarse layer (1.2-6 mm) everywhere, a fine one (0.3-1.5 mm) that wetness scales."""
        rng, step = self.rng, FILM_MM / FILM
        slopes = []
        for low, high, tilt in ((3.0, 12.0, 1.6), (0.35, 2.5, 1.5)):
            h = periodic_noise(rng, FILM, low, high, tilt)
            gx = (np.roll(h, -1, 1) - np.roll(h, 1, 1)) / (2 * step)
            gy = (np.roll(h, -1, 0) - np.roll(h, 1, 0)) / (2 * step)
            norm = np.sqrt((gx * gx + gy * gy).mean() / 2)
            slopes += [gx / norm, gy / norm]
        self.film = np.stack(slopes, -1).astype(np.float32)      # unit deviation per axis


DETAIL = 0.6
