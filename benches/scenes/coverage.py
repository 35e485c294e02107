"""How many survey views see the tissue (taken as the plane z = 8 mm) that the live frames show, and under which spread of angles."""
import sys
import numpy as np
import make, paths
from render import K, W, H
spec = make.SETS[sys.argv[1]]
sv = paths.Path("survey", spec["seed"], spec["survey"] / 25).scene_from_camera(np.arange(spec["survey"]) / 25)
lv = paths.Path("live", spec["seed"], spec["live"] / 25).scene_from_camera(np.arange(spec["live"]) / 25)
u, v = np.meshgrid(np.linspace(20, W - 20, 24), np.linspace(20, H - 20, 14))
rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1).reshape(-1, 3)
counts, spread = [], []
for m in lv[::6]:
    d = rays @ m[:3, :3].T
    p = m[:3, 3] + d * ((8 - m[2, 3]) / d[:, 2])[:, None]
    seen, dirs = np.zeros(len(p), int), []
    for s in sv:
        q = (p - s[:3, 3]) @ s[:3, :3]
        x, y = q[:, 0] / q[:, 2] * K[0, 0] + K[0, 2], q[:, 1] / q[:, 2] * K[1, 1] + K[1, 2]
        ok = (x > 5) & (x < W - 5) & (y > 5) & (y < H - 5) & (q[:, 2] > 0)
        seen += ok
        e = s[:3, 3] - p
        dirs.append(np.where(ok[:, None], e / np.linalg.norm(e, axis=1, keepdims=True), np.nan))
    counts.append(seen)
    dirs = np.array(dirs)
    mean = np.nanmean(dirs, 0)
    spread.append(np.degrees(np.sqrt(np.nanmean(np.arccos(np.clip((dirs * (mean / np.linalg.norm(mean, axis=1, keepdims=True))).sum(-1), -1, 1)) ** 2, 0))))
c = np.concatenate(counts)
print("survey views per live point: min, 5 %, median, max", c.min(), np.quantile(c, .05), np.median(c), c.max(), " seen by none", (c == 0).mean(),
      " rms angle to the mean view, median", np.nanmedian(np.concatenate(spread)))
