"""Difficulty of a set's live clip on a few frames, before it is rendered: as it is, and Telea with the true mask."""
import sys

import cv2
import numpy as np

import figures
import make
import render
import scene

name = sys.argv[1]
frames = [int(v) for v in sys.argv[2].split(",")]
for pair in sys.argv[3:]:
    key, value = pair.split("=")
    setattr(render, key, float(value))
r = render.Renderer(scene.Scene(make.SETS[name]["seed"]), 1)
rows = []
for k, (clean, full, seen) in zip(frames, make.clip(r, make.SETS[name], "live", None, only=frames)):
    clean, full, seen = make.byte(clean), make.byte(full), make.byte(seen)
    above = (full.astype(int) - clean).max(-1)
    mask = above > 6
    tel = cv2.inpaint(seen, np.uint8(mask) * 255, 3, cv2.INPAINT_TELEA)
    rows.append([figures.errors(clean, seen, mask), figures.errors(clean, tel, mask)])
    print(k, f"mask {mask.mean():.4f} strong {(above > 40).mean():.4f} saturated {((full.min(-1) > 250)).mean():.4f} mean {full.mean():.0f}")
    cv2.imwrite(f"tune_{k}.png", np.vstack([seen, clean])[..., ::-1])
for i, label in enumerate(("as it is", "telea")):
    print(label, figures.summary([row[i] for row in rows]))
