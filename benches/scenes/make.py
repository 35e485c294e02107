"""Renders one set: recordings in the project's format and their truth.  usage: make.py rigid|joints|breathing|rolling [OUT [survey|live]]"""
import csv
import pathlib
import subprocess
import sys
import time

import cv2
import numpy as np
from scipy.spatial.transform import Rotation as R

import paths
import render
from render import DISTORTION, H, K, W

SETS = {   # seed, arm, survey frames, live frames
    "rigid": dict(seed=11, arm="pose", survey=90, live=60),
    "joints": dict(seed=31, arm="joints", survey=90, live=60),
    "breathing": dict(seed=11, arm="pose", survey=190, live=60, breathing=True, tool=True),
    "rolling": dict(seed=11, arm="pose", survey=0, live=250),
}
FPS = 25.0
TARGET_LEVEL = 0.135          # mean linear value that exposure aims at
MAPS = cv2.initUndistortRectifyMap(K, DISTORTION, None, K, (W, H), cv2.CV_32FC1)


def srgb(x):
    x = np.clip(x, 0, 1)
    return 255 * np.where(x < 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4) - 0.055)


def flat(image):
    """Undistorted to the pinhole camera of camera.yaml."""
    return cv2.remap(image.astype(np.float32), *MAPS, cv2.INTER_LINEAR)


def byte(x):
    return np.clip(x + 0.5, 0, 255).astype(np.uint8)


def expose(diffuse, specular, steel, exposure):
    """-> noise-free full picture and the same without the tissue's specular light, linear, not clipped."""
    clean = (diffuse + steel) * exposure
    return clean + specular * exposure, clean


def noise(rng, linear):
    seen = np.clip(linear, 0, None)
    return linear + rng.standard_normal(linear.shape).astype(np.float32) * np.sqrt(0.0010 ** 2 + 1.7e-4 * seen)


class Encoder:
    def __init__(self, path):
        self.p = subprocess.Popen(
            ["ffmpeg", "-v", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{W}x{H}", "-r", "25", "-i", "-",
             "-vf", "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+full_chroma_int", "-pix_fmt", "yuv420p", "-c:v", "libx264",
             "-crf", "11", "-preset", "faster", "-threads", "1", "-color_primaries", "bt709", "-color_trc", "bt709", "-colorspace", "bt709",
             "-color_range", "tv", str(path)], stdin=subprocess.PIPE)

    def add(self, image):
        self.p.stdin.write(image.tobytes())

    def close(self):
        self.p.stdin.close()
        if self.p.wait():
            raise RuntimeError("ffmpeg failed")


def write_tum(path, header, stamps, poses):
    with open(path, "w") as f:
        f.write(header + "\n")
        for t, m in zip(stamps, poses):
            q = R.from_matrix(m[:3, :3]).as_quat()
            f.write(f"{t:.6f} " + " ".join(f"{v:.6f}" for v in m[:3, 3]) + " " + " ".join(f"{v:.9f}" for v in q) + "\n")


def write_camera(path):
    p = [K[0, 0], 0, K[0, 2], 0, 0, K[1, 1], K[1, 2], 0, 0, 0, 1, 0]
    rows = lambda v: "[" + ", ".join(f"{x:.9g}" for x in v) + "]"
    path.write_text(
        f"image_width: {W}\nimage_height: {H}\ncamera_name: scope\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: {rows(K.ravel())}\n"
        f"distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: {rows(DISTORTION)}\n"
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
        f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: {rows(p)}\n")


def write_hand_eye(path):
    m = paths.HAND_FROM_CAMERA
    t, q = m[:3, 3], R.from_matrix(m[:3, :3]).as_quat()
    path.write_text("# hand_from_camera\nunit: mm\n"
                    f"translation: {{x: {t[0]:.6f}, y: {t[1]:.6f}, z: {t[2]:.6f}}}\n"
                    f"rotation: {{x: {q[0]:.9f}, y: {q[1]:.9f}, z: {q[2]:.9f}, w: {q[3]:.9f}}}\n")


def write_poses(path, spec, kind, clock, rec, truth):
    """What the arm says (late, noisy) and what the hand did."""
    seed, seconds = spec["seed"], spec[kind] / FPS
    if spec["arm"] == "joints":
        t, told, joints, read = paths.joint_poses(path, seed, seconds)
        np.savetxt(truth / "joints_true_and_read_rad.csv", np.hstack([(t + clock)[:, None], joints, read]), fmt="%.9f", delimiter=",",
                   header="true time on the frames' clock, six true joints, six read joints")
    else:
        t, told = paths.noisy_poses(path, seed + (0 if kind == "survey" else 1000), seconds)
    write_tum(rec / "poses.tum", "# T_base_hand, mm", t + clock + paths.LATE_S, told)
    write_tum(truth / "hand_poses.tum", "# T_base_hand, mm (true, stamps on the frames' clock)", t + clock, paths.BASE_FROM_SCENE @ path.scene_from_hand(t))


def clip(renderer, spec, kind, out, only=None):
    """Renders one recording and its truth.  `only`: yields (truth undistorted, noisy undistorted) for a few frames instead."""
    count, seed = spec[kind], spec["seed"]
    seconds = count / FPS
    path = paths.Path("rolling" if kind == "live" and not spec["survey"] else kind, seed, seconds)
    rng = np.random.default_rng([seed, 5 if kind == "survey" else 6])
    times = np.arange(count) / FPS + rng.normal(0, 0.0002, count)
    clock = 1723.4178 if kind == "survey" else 2958.0631
    poses = path.scene_from_camera(times)
    began = 0.0 if kind == "survey" else 41.3            # the live clip is made later: another phase of the breath
    breathing = spec.get("breathing", False)

    def shoot(k):
        if breathing or renderer.with_tool:
            t = times[k] + began
            tool = paths.tool_pose(times[k], seconds) if spec.get("tool") and kind == "live" else None
            renderer.move(paths.breath_mm(t) if breathing else 0, paths.heart_mm(t) if breathing else 0, tool)
        return renderer.frame(poses[k])

    exposure = None
    if only is not None:
        for k in only:
            d, s, st, tool, depth = shoot(k)
            full, clean = expose(d, s, st, TARGET_LEVEL / np.minimum(d + s, 4 * d.mean()).mean())
            yield flat(srgb(clean)), flat(srgb(full)), flat(byte(srgb(noise(rng, full))))
        return

    rec, truth = out / kind, out / "truth" / kind
    names = ["diffuse_undistorted", "above_undistorted", "specular_undistorted"]
    if kind == "live":
        names += ["diffuse", "above", "specular"]
    if spec.get("tool") and kind == "live":
        names += ["instrument", "instrument_undistorted"]
    for n in names:
        (truth / n).mkdir(parents=True, exist_ok=True)
    rec.mkdir(parents=True, exist_ok=True)
    png = lambda name, image: name in names and cv2.imwrite(str(truth / name / f"{k:06d}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    video = Encoder(rec / "video.mp4")
    log, start = [], time.time()
    for k in range(count):
        d, s, st, tool, depth = shoot(k)
        wanted = TARGET_LEVEL / np.minimum(d + s + st, 4 * d.mean()).mean()
        exposure = wanted if exposure is None else exposure * (wanted / exposure) ** 0.12
        full, clean = expose(d, s, st, exposure)
        video.add(byte(srgb(noise(rng, full))))
        full, clean = srgb(full), srgb(clean)
        uf, uc = flat(full), flat(clean)
        no_tool, no_tool_u = tool < 0.02, flat(tool) < 0.02
        above = (full - clean).max(-1) * no_tool
        above_u = (uf - uc).max(-1) * no_tool_u
        png("diffuse", byte(clean)[..., ::-1]), png("diffuse_undistorted", byte(uc)[..., ::-1])
        png("above", byte(above)), png("above_undistorted", byte(above_u))
        png("specular", np.uint8(above > 6) * 255), png("specular_undistorted", np.uint8(above_u > 6) * 255)
        if spec.get("tool") and kind == "live":
            png("instrument", np.uint8(~no_tool) * 255), png("instrument_undistorted", np.uint8(~no_tool_u) * 255)
        log.append((k, exposure, (above > 6).mean(), (above > 40).mean(), (~no_tool).mean()))
        if k % 10 == 0:
            print(f"{kind} {k}/{count}  {(time.time() - start) / (k + 1):.2f} s/frame  specular {log[-1][2]:.3f}", flush=True)
    video.close()
    with open(rec / "frames.csv", "w") as f:
        f.write("frame,timestamp_s\n" + "".join(f"{k},{t + clock:.6f}\n" for k, t in enumerate(times)))
    write_poses(path, spec, kind, clock, rec, truth)
    write_tum(truth / "camera_poses.tum", "# T_world_camera, mm", times + clock, paths.BASE_FROM_SCENE @ poses)
    write_camera(rec / "camera.yaml")
    write_hand_eye(rec / "hand_eye.yaml")
    with open(truth / "frames.csv", "w") as f:
        f.write("frame,timestamp_s,exposure,specular_share,strong_share,instrument_share,breath_mm,heart_mm\n")
        for (k, e, a, b, c), t in zip(log, times):
            br, he = (paths.breath_mm(t + began), paths.heart_mm(t + began)) if breathing else (0, 0)
            f.write(f"{k},{t + clock:.6f},{e:.6f},{a:.6f},{b:.6f},{c:.6f},{br:.4f},{he:.4f}\n")


def main():
    name = sys.argv[1]
    out = pathlib.Path(sys.argv[2] if len(sys.argv) > 2 else pathlib.Path(__file__).parent / name)
    spec = SETS[name]
    import scene
    renderer = render.Renderer(scene.Scene(spec["seed"]), spec["seed"], with_tool=spec.get("tool", False))
    for kind in sys.argv[3:] or ("survey", "live"):
        if spec[kind]:
            for _ in clip(renderer, spec, kind, out):
                pass


if __name__ == "__main__":
    main()
