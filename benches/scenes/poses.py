"""Refined survey poses of a light field against the truth.  usage: poses.py LF SET [--kind survey]

Reads LF/sparse/images.txt (camera_from_world, qw first; image names are frame numbers) and aligns the camera centres and
orientations to the true ones by one rigid motion, without scale."""
import argparse
import pathlib

import numpy as np
from scipy.spatial.transform import Rotation as R


def colmap(path):
    """{frame: world_from_camera}; the second line of each pair (points) may be empty."""
    lines = [l for l in path.read_text().splitlines() if not l.startswith("#")]
    out = {}
    for line in lines[::2]:
        v = line.split()
        if len(v) < 10:
            continue
        r = R.from_quat([*map(float, v[2:5]), float(v[1])]).as_matrix()
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = r.T, -r.T @ np.array(list(map(float, v[5:8])))
        out[int(pathlib.PurePosixPath(v[9]).stem)] = m
    return out


def tum(path):
    rows = np.array([list(map(float, l.split())) for l in path.read_text().splitlines() if l and not l.startswith("#")])
    m = np.tile(np.eye(4), (len(rows), 1, 1))
    m[:, :3, :3], m[:, :3, 3] = R.from_quat(rows[:, 4:]).as_matrix(), rows[:, 1:4]
    return rows[:, 0], m


def report(label, estimate, truth):
    e, t = np.array(estimate), np.array(truth)
    # rotation from centres and axes together: 300 mm along each camera axis count as points too (an arm errs by about 0.7 mm and 0.13 deg)
    points = lambda m: np.concatenate([m[:, :3, 3]] + [m[:, :3, 3] + 300 * m[:, :3, k] for k in range(3)])
    a, b = points(e), points(t)
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    r = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    s = b.mean(0) - r @ a.mean(0)
    for name, rot, shift in (("as they are", np.eye(3), np.zeros(3)), ("aligned", r, s)):
        miss = np.linalg.norm(e[:, :3, 3] @ rot.T + shift - t[:, :3, 3], axis=1)
        turn = np.degrees((R.from_matrix(rot @ e[:, :3, :3]).inv() * R.from_matrix(t[:, :3, :3])).magnitude())
        print(f"{label}, {name:11}: {len(e)} views, position rms {np.sqrt((miss ** 2).mean()):.3f} mm (max {miss.max():.3f}), "
              f"rotation mean {turn.mean():.3f} deg (max {turn.max():.3f})")
    scale = np.linalg.norm(e[:, :3, 3] - e[:, :3, 3].mean(0)) / np.linalg.norm(t[:, :3, 3] - t[:, :3, 3].mean(0))
    print(f"{label}: extent of the centres, estimate / truth = {scale:.5f}")


def main():
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("lf", help="light field, or - for the arm's own poses (true hand-eye, true 40 ms)")
    p.add_argument("set")
    p.add_argument("--kind", default="survey")
    a = p.parse_args()
    root = pathlib.Path(a.set)
    stamps, truth = tum(root / "truth" / a.kind / "camera_poses.tum")
    # the arm's poses at the frames, for comparison
    import paths
    from scipy.spatial.transform import Slerp
    t, hand = tum(root / a.kind / "poses.tum")
    t = t - paths.LATE_S
    arm = np.tile(np.eye(4), (len(stamps), 1, 1))
    arm[:, :3, :3] = Slerp(t, R.from_matrix(hand[:, :3, :3]))(stamps).as_matrix()
    arm[:, :3, 3] = np.stack([np.interp(stamps, t, hand[:, k, 3]) for k in range(3)], -1)
    report("arm", arm @ paths.HAND_FROM_CAMERA, truth)
    if a.lf != "-":
        views = colmap(pathlib.Path(a.lf) / "sparse" / "images.txt")
        keys = sorted(views)
        report("light field", [views[k] for k in keys], truth[keys])


if __name__ == "__main__":
    main()
