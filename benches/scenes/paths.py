"""Where the scope goes: trocar kinematics, hand-like paths, and what a noisy arm says about them.

World = robot base.  base_from_scene places the tissue in front of the robot; the hand's z axis is the shaft."""
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation as R

TROCAR = np.array([0.0, 0.0, 158.0])          # scene frame; tissue around z = 0..20
SHAFT = 300.0                                 # hand to camera along the shaft, mm
LATE_S = 0.040                                # pose stamps lag by this


def transform(rotation, translation):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = rotation.as_matrix(), translation
    return m


BASE_FROM_SCENE = transform(R.from_euler("zyx", [23.0, 1.2, -0.8], degrees=True), [462.0, -131.0, 18.0])
HAND_FROM_CAMERA = transform(R.from_euler("zyx", [13.0, 1.1, -1.6], degrees=True), [1.7, -2.4, SHAFT])


def wander(rng, t, scale_s, count):
    """Smooth random curves of unit deviation that do not repeat; t must be evenly spaced."""
    step = t[1] - t[0]
    pad = int(4 * scale_s / step)
    w = gaussian_filter1d(rng.standard_normal((count, len(t) + 2 * pad)), scale_s / step, axis=1)
    # unit deviation of the process, not of the sample
    return w[:, pad:-pad] * np.sqrt(2 * np.sqrt(np.pi) * scale_s / step)


class Path:
    """Four degrees of freedom over time, tabulated at 500 Hz and interpolated."""

    def __init__(self, kind, seed, seconds):
        self.t = np.arange(-0.6, seconds + 0.6, 0.002)
        t, rng = self.t, np.random.default_rng([seed, {"survey": 1, "live": 2, "rolling": 3}[kind]])
        hand = wander(rng, t, 0.35, 4)
        tremor = wander(rng, t, 0.03, 4)
        a, b = rng.uniform(-0.3, 0.3, 2)
        if kind == "survey":
            loops = max(1.0, seconds / 3.6)
            w = 2 * np.pi * loops / seconds
            yaw = 20 * np.sin(w * t * 1.0 + a) + 1.0 * hand[0]
            pitch = 17 * np.sin(w * t * 1.5 + 1.1 + b) + 1.0 * hand[1]
            depth = 69 + 13 * np.sin(w * t * 0.8 + 2 + a) + 1.0 * hand[2]
            roll = 9 * np.sin(w * t * 0.6 + b) + 1.0 * hand[3]
        elif kind == "live":
            w = 2 * np.pi / seconds
            yaw = 4 + 8.5 * np.sin(w * t * 0.9 - 1.0 + a) + 0.6 * hand[0]
            pitch = -1 + 6.5 * np.cos(w * t * 0.7 + b) + 0.6 * hand[1]
            depth = 67 + 6 * np.sin(w * t * 0.8 + 0.5) + 0.6 * hand[2]
            roll = 4 + 4 * np.sin(w * t * 0.5 + 1) + 0.6 * hand[3]
        else:                                    # rolling: a slow figure at a steady 10 mm/s
            s = t * 1.0
            yaw, pitch = 10 * np.sin(s * 0.9 + a), 7 * np.sin(s * 1.3 + b)
            depth, roll = 68 + 3 * np.sin(s * 0.7), 2 * np.sin(s * 0.5)
            centre = self._hands(yaw, pitch, depth, roll)[:, :3, 3] + self._hands(yaw, pitch, depth, roll)[:, :3, 2] * SHAFT
            length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(centre, axis=0), axis=1))])
            zero = np.interp(0, t, length)
            at = np.interp(zero + 10.0 * np.clip(t, 0, None), length, t)   # needs speed > 10 mm/s on the raw figure
            at[t < 0] = 0
            yaw, pitch, depth, roll = (np.interp(at, t, q) for q in (yaw, pitch, depth, roll))
        self.dof = np.stack([yaw + 0.03 * tremor[0], pitch + 0.03 * tremor[1], depth + 0.06 * tremor[2], roll + 0.05 * tremor[3]])

    @staticmethod
    def _hands(yaw, pitch, depth, roll):
        """Scene-from-hand matrices: the shaft goes through the trocar, the lens `depth` mm before the mean tissue plane."""
        turn = R.from_euler("x", 180, degrees=True) * R.from_euler("yxz", np.stack([yaw, pitch, roll], -1), degrees=True)
        m = np.tile(np.eye(4), (len(yaw), 1, 1))
        m[:, :3, :3] = turn.as_matrix()
        axis = m[:, :3, 2]
        to_tissue = (TROCAR[2] - 7.0) / -axis[:, 2]
        m[:, :3, 3] = TROCAR + axis * (to_tissue - depth - SHAFT)[:, None]
        return m

    def scene_from_hand(self, times):
        return self._hands(*[np.interp(times, self.t, q) for q in self.dof])

    def scene_from_camera(self, times):
        return self.scene_from_hand(times) @ HAND_FROM_CAMERA


def coloured(rng, t, count):
    """Arm noise of unit deviation: structured (0.4 s correlation, 80 %) and white (60 %)."""
    return 0.8 * wander(rng, t, 0.28, count) + 0.6 * rng.standard_normal((count, len(t)))


def noisy_poses(path, seed, seconds, rate_hz=50.0, mm=0.25, deg=0.08):
    """(true time, base_from_hand as the arm tells it)."""
    rng = np.random.default_rng([seed, 77])
    t = np.arange(-0.31, seconds + 0.31, 1 / rate_hz)
    true = BASE_FROM_SCENE @ path.scene_from_hand(t)
    shift, turn = coloured(rng, t, 3).T * mm, coloured(rng, t, 3).T * deg
    out = true.copy()
    out[:, :3, 3] += shift
    out[:, :3, :3] = (R.from_matrix(true[:, :3, :3]) * R.from_rotvec(turn, degrees=True)).as_matrix()
    return t, out


# ---- a six-joint serial arm (standard DH, about a metre of reach) -----------------------------------------------
DH = np.array([[0, np.pi / 2, 118.0], [-418.0, 0, 0], [-387.0, 0, 0], [0, np.pi / 2, 112.5], [0, -np.pi / 2, 97.0], [0, 0, 84.0]])  # a, alpha, d


def forward(q):
    m = np.eye(4)
    for (a, alpha, d), th in zip(DH, q):
        c, s, ca, sa = np.cos(th), np.sin(th), np.cos(alpha), np.sin(alpha)
        m = m @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
    return m


def _error(m, target):
    return np.concatenate([target[:3, 3] - m[:3, 3], 300 * R.from_matrix(target[:3, :3] @ m[:3, :3].T).as_rotvec()])


def inverse(target, q):
    for _ in range(200):
        m = forward(q)
        e = _error(m, target)
        if np.abs(e).max() < 1e-8:
            return q, True
        J = np.empty((6, 6))
        for k in range(6):
            p = q.copy()
            p[k] += 1e-6
            J[:, k] = -(_error(forward(p), target) - e) / 1e-6
        step = np.linalg.solve(J.T @ J + 1e-3 * np.eye(6), J.T @ e)
        q = q + step * min(1.0, 0.4 / np.abs(step).max())
    return q, False


def joint_poses(path, seed, seconds, rate_hz=50.0, deg=0.1):
    """Poses through the arm's joints: offset per joint, backlash by direction of motion, slow and white noise, 0.1 deg together."""
    rng = np.random.default_rng([seed, 78, round(seconds * 1000)])     # noise: another one in each recording
    arm = np.random.default_rng([seed, 79])                            # offsets and elbow: one arm for all recordings
    t = np.arange(-0.31, seconds + 0.31, 1 / rate_hz)
    true = BASE_FROM_SCENE @ path.scene_from_hand(t)
    home, q = BASE_FROM_SCENE @ Path._hands(*np.array([[0.0], [0.0], [70.0], [0.0]]))[0], None
    for _ in range(400):                      # any start that leads to a pose far from singular
        guess, ok = inverse(home, arm.uniform(-np.pi, np.pi, 6))
        if ok and np.linalg.svd(_jacobian(guess), compute_uv=False)[-1] > 25:
            q = guess
            break
    if q is None:
        raise RuntimeError("the arm does not reach the site")
    joints = []
    for m in true:
        q, ok = inverse(m, q)
        if not ok:
            raise RuntimeError("the arm does not reach the path")
        joints.append(q)
    joints = np.array(joints)
    offset = arm.normal(0, deg, 6)
    speed = np.gradient(joints, axis=0) * rate_hz
    slip = np.zeros_like(joints)              # the gear lies on one flank until it has moved through the play
    play = np.radians(0.06)
    lag = joints[0].copy()
    for i, row in enumerate(joints):
        lag = np.clip(lag, row - play / 2, row + play / 2)
        slip[i] = lag - row
    noise = 0.05 * wander(rng, t, 0.3, 6).T + 0.02 * rng.standard_normal((len(t), 6))
    read = joints + np.radians(offset + noise) + slip
    return t, np.array([forward(r) for r in read]), joints, read


def _jacobian(q):
    base = forward(q)
    return np.array([-(_error(forward(q + 1e-6 * np.eye(6)[k]), base)) / 1e-6 for k in range(6)]).T


# ---- organ motion and tool --------------------------------------------------------------------------------------
def breath_mm(t, phase=0.0):
    """3.5 mm, 12 a minute, quicker in than out, a rest at the end of expiration."""
    x = (t * 12 / 60 + phase) % 1.0
    warped = x / 0.4 * 0.5 if x < 0.4 else 0.5 + (x - 0.4) / 0.6 * 0.5
    return 3.5 * np.sin(np.pi * warped) ** 3


def heart_mm(t):
    x = t * 70 / 60
    return 0.5 * (0.75 * np.sin(2 * np.pi * x) + 0.25 * np.sin(4 * np.pi * x + 0.7))


def tool_pose(t, seconds):
    """Scene-from-tool: enters from the side in the second quarter of the clip, crosses and leaves; None when away."""
    x = (t / seconds - 0.17) / 0.66
    if not 0 <= x <= 1:
        return None
    tip = np.array([-14 + 34 * np.sin(np.pi * x) * 0.9 + 6 * x, 24 - 52 * np.sin(np.pi * x) ** 0.8, 33.0 + 4 * np.sin(5 * x)])
    tip[1] += 60 * (1 - np.sin(np.pi * x) ** 0.5)
    entry = np.array([62.0, 118.0, 118.0])
    z = (entry - tip) / np.linalg.norm(entry - tip)
    x_ = np.cross([0, 0, 1.0], z)
    x_ /= np.linalg.norm(x_)
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = np.stack([x_, np.cross(z, x_), z], -1), tip
    return m
