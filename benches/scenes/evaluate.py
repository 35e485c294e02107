"""Judges a processed live clip against a set's truth.

usage: evaluate.py SET OUTPUT.mp4 MASK.mkv [--kind live] [--json FILE] [--per-frame] [--strip FILE.png] [--frames N] [--offset N]

Everything is compared in the undistorted picture.  Columns "as it is", "telea" and "ns" are cached in SET/baseline_KIND.json.
Tissue under the tool (instrument mask grown by 3 px) takes no part in the specular figures."""
import argparse
import json
import pathlib
import subprocess
import sys

import cv2
import numpy as np

import figures

W, H = 960, 540
TELEA_RADIUS_PX = 3


def frames_of(path, gray=False):
    """Frames as ffmpeg decodes them (rgb24, or gray for a mask); a folder or pattern of PNGs is read too."""
    path = str(path)
    if path.endswith("/") or pathlib.Path(path).is_dir():
        for f in sorted(pathlib.Path(path).glob("*.png")):
            image = cv2.imread(str(f), cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_COLOR)
            yield image if gray else image[..., ::-1]
        return
    fmt, n = ("gray", 1) if gray else ("rgb24", 3)
    scale = ["-vf", "format=gray"] if gray else ["-vf", "scale=in_color_matrix=bt709:in_range=tv:flags=accurate_rnd+full_chroma_int+full_chroma_inp"]
    p = subprocess.Popen(["ffmpeg", "-v", "error", "-i", path, "-map", "0:v:0", "-vsync", "0", *scale, "-f", "rawvideo", "-pix_fmt", fmt, "-"],
                         stdout=subprocess.PIPE)
    while True:
        raw = p.stdout.read(W * H * n)
        if len(raw) < W * H * n:
            break
        yield np.frombuffer(raw, np.uint8).reshape((H, W) if gray else (H, W, 3))
    p.stdout.close()
    if p.wait():
        sys.exit(f"ffmpeg could not decode {path}")


def camera(path):
    data = {}
    for block in ("camera_matrix", "distortion_coefficients"):
        text = path.read_text().split(block + ":")[1]
        data[block] = np.array(json.loads("[" + text.split("[")[1].split("]")[0] + "]"))
    return data["camera_matrix"].reshape(3, 3), data["distortion_coefficients"]


class Truth:
    def __init__(self, root, kind):
        self.at = pathlib.Path(root) / "truth" / kind
        self.k, self.dist = camera(pathlib.Path(root) / kind / "camera.yaml")
        self.maps = cv2.initUndistortRectifyMap(self.k, self.dist, None, self.k, (W, H), cv2.CV_32FC1)

    def _png(self, name, k):
        path = self.at / name / f"{k:06d}.png"
        return cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.exists() else None

    def frame(self, k):
        diffuse = self._png("diffuse_undistorted", k)[..., ::-1]
        above = self._png("above_undistorted", k)
        tool = self._png("instrument_undistorted", k)
        tool = np.zeros((H, W), bool) if tool is None else tool > 127
        near_tool = cv2.dilate(np.uint8(tool), np.ones((7, 7), np.uint8)) > 0
        return diffuse, above, tool, near_tool

    def undistort(self, image):
        return cv2.remap(image, *self.maps, cv2.INTER_LINEAR)


def far(mask, px):
    """Pixels farther than px from the mask."""
    if not mask.any():
        return np.ones(mask.shape, bool)
    return cv2.distanceTransform(np.uint8(~mask), cv2.DIST_L2, 5) > px


def baselines(root, kind, count):
    cache = pathlib.Path(root) / f"baseline_{kind}.json"
    if cache.exists():
        return json.loads(cache.read_text())
    truth, sums, shares, strong = Truth(root, kind), {"as it is": [], "telea": [], "ns": []}, [], []
    for k, raw in enumerate(frames_of(pathlib.Path(root) / kind / "video.mp4")):
        clean, above, tool, near_tool = truth.frame(k)
        mask = (above > 6) & ~near_tool
        seen = truth.undistort(raw)
        th, tg, holes = figures.high(clean), figures.gray(clean), np.uint8(mask) * 255
        box = mask
        sums["as it is"].append(figures.errors(clean, seen, box, th, tg))
        for name, flag in (("telea", cv2.INPAINT_TELEA), ("ns", cv2.INPAINT_NS)):
            sums[name].append(figures.errors(clean, cv2.inpaint(seen, holes, TELEA_RADIUS_PX, flag), box, th, tg))
        shares.append(mask.mean()), strong.append((above > 40).mean())
    out = {name: figures.summary(rows) for name, rows in sums.items()}
    out["specular_share"], out["strong_share"] = float(np.mean(shares)), float(np.mean(strong))
    cache.write_text(json.dumps(out, indent=1))
    return out


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("set")
    p.add_argument("output", nargs="?")
    p.add_argument("mask", nargs="?")
    p.add_argument("--kind", default="live")
    p.add_argument("--json")
    p.add_argument("--per-frame", action="store_true", help="print the worst frames")
    p.add_argument("--strip", help="input | output | truth | |difference| x 4 of the worst frame, as PNG")
    p.add_argument("--strip-frame", type=int, help="that frame instead of the worst")
    p.add_argument("--offset", type=int, default=0, help="first output frame is this frame of the recording")
    p.add_argument("--frames", type=int, help="stop after so many output frames")
    a = p.parse_args()
    base = baselines(a.set, a.kind, None)
    if a.output is None:
        print(json.dumps(base, indent=1))
        return
    truth = Truth(a.set, a.kind)
    rows, filled_rows, truth_filled, frames = [], [], [], []
    total = dict(strong=0, strong_filled=0, weak=0, weak_filled=0, false=0, pixels=0, else_n=0, else_se=0.0, quiet_n=0, quiet_se=0.0, tool=0, tool_filled=0,
                 touched=0, from_lf=0, from_recent=0, made_up=0, left=0, in_n=0, in_d=0.0, ring_n=0, ring_d=0.0, tin_d=0.0, tring_d=0.0)
    last, worst = None, None
    raws, outs, masks = frames_of(pathlib.Path(a.set) / a.kind / "video.mp4"), frames_of(a.output), frames_of(a.mask, gray=True)
    for _ in range(a.offset):
        next(raws)
    k = a.offset - 1
    done = False
    for out in outs:
        raw, mask = next(raws, None), next(masks, None)
        if raw is None or mask is None:
            sys.exit(f"frame {k + 1} of the output has no {'input' if raw is None else 'mask'}: counts differ")
        k += 1
        if a.frames and k - a.offset >= a.frames:
            done = True
            break
        clean, above, tool, near_tool = truth.frame(k)
        spec = (above > 6) & ~near_tool
        seen = truth.undistort(raw)
        filled, touched = mask >= 128, mask > 0
        th, tg = figures.high(clean), figures.gray(clean)
        row = figures.errors(clean, out, spec, th, tg)
        rows.append(row)
        hit = spec & filled
        filled_rows.append(figures.errors(clean, out, hit, th, tg))
        truth_filled.append(figures.errors(clean, seen, hit, th, tg))
        strong = (above > 40) & ~near_tool
        weak = spec & ~strong
        total["strong"] += strong.sum(); total["strong_filled"] += (strong & filled).sum()
        total["weak"] += weak.sum(); total["weak_filled"] += (weak & filled).sum()
        astray = filled & far(above > 6, 10) & ~tool
        total["false"] += astray.sum(); total["pixels"] += spec.size
        away = far(above > 6, 12)
        se = ((out.astype(np.float32) - seen) ** 2).mean(-1)
        total["else_n"] += away.sum(); total["else_se"] += se[away].sum(dtype=np.float64)
        quiet = away & far(touched, 12)
        total["quiet_n"] += quiet.sum(); total["quiet_se"] += se[quiet].sum(dtype=np.float64)
        total["tool"] += tool.sum(); total["tool_filled"] += (tool & filled).sum()
        for name, value in (("from_lf", 255), ("from_recent", 128), ("made_up", 192), ("left", 64)):
            total[name] += (mask == value).sum()
        total["touched"] += touched.sum()
        if last is not None:
            both = filled & last[1]
            either = np.uint8(filled | last[1] | touched | last[3])
            ring = (cv2.dilate(either, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (25, 25))) > 0) & (cv2.dilate(either, np.ones((5, 5), np.uint8)) == 0)
            ring &= ~(cv2.dilate(np.uint8((above > 6) | (last[4] > 6) | near_tool), np.ones((5, 5), np.uint8)) > 0)
            d = np.abs(out.astype(np.float32) - last[0]).mean(-1)
            t = np.abs(clean.astype(np.float32) - last[2]).mean(-1)
            total["in_n"] += both.sum(); total["in_d"] += d[both].sum(dtype=np.float64); total["tin_d"] += t[both].sum(dtype=np.float64)
            total["ring_n"] += ring.sum(); total["ring_d"] += d[ring].sum(dtype=np.float64); total["tring_d"] += t[ring].sum(dtype=np.float64)
        last = (out.astype(np.float32), filled, clean.astype(np.float32), touched, above)
        s = figures.summary([row])
        frames.append(dict(frame=k, **s, specular=float(spec.mean()), recall=float((strong & filled).sum() / max(strong.sum(), 1)),
                           false=float(astray.mean()), error=float(row[1])))
        chosen = k == a.strip_frame if a.strip_frame is not None else worst is None or row[1] > worst[0]
        if chosen:
            worst = (row[1], k, seen, out, clean)
    if not done and next(masks, None) is not None:
        print("warning: the mask has more frames than the output")
    if not frames:
        sys.exit("the output has no frames")
    n = len(frames)
    expected = sum(1 for _ in raws)
    if expected and not a.frames:
        print(f"warning: the output ends {expected} frames before the input")
    ratio = lambda x, y: float(x / y) if y else None
    jitter = ratio(total["in_d"] / max(total["in_n"], 1), total["ring_d"] / max(total["ring_n"], 1))
    result = dict(
        frames=n, **figures.summary(rows), recall=ratio(total["strong_filled"], total["strong"]), weak_recall=ratio(total["weak_filled"], total["weak"]),
        false_touches=ratio(total["false"], total["pixels"]), elsewhere=figures.psnr(total["else_se"] / total["else_n"]),
        elsewhere_untouched=figures.psnr(total["quiet_se"] / total["quiet_n"]) if total["quiet_n"] else None, instrument_painted_px=int(total["tool_filled"]),
        instrument_painted_share=ratio(total["tool_filled"], total["tool"]), jitter=jitter,
        jitter_of_truth=ratio(total["tin_d"] / max(total["in_n"], 1), total["tring_d"] / max(total["ring_n"], 1)),
        from_light_field=ratio(total["from_lf"], total["touched"]), from_recent=ratio(total["from_recent"], total["touched"]),
        made_up=ratio(total["made_up"], total["touched"]), left=ratio(total["left"], total["touched"]), touched_share=ratio(total["touched"], total["pixels"]),
        filled_only=figures.summary(filled_rows), filled_only_as_it_is=figures.summary(truth_filled), baselines=base)
    show = lambda v, f="{:9.2f}": f.format(v) if v is not None else "        -"
    print(f"{a.set}: {n} frames, specular {base['specular_share']:.3%} of the frame, strong {base['strong_share']:.3%}")
    print(f"{'':24}{'texture':>9}{'SSIM':>9}{'plain':>9}")
    for label, s in (("as it is", base["as it is"]), ("telea, true mask", base["telea"]), ("ns, true mask", base["ns"]), ("OUTPUT", result),
                     ("output, filled only", result["filled_only"]), ("as it is, same pixels", result["filled_only_as_it_is"])):
        print(f"{label:24}{show(s['texture_psnr'])}{show(s['ssim'], '{:9.3f}')}{show(s['plain_psnr'])}")
    pct = lambda v: "-" if v is None else f"{v:.3%}"
    print(f"recall {pct(result['recall'])} (weak halo {pct(result['weak_recall'])})   false touches {pct(result['false_touches'])}   touched {pct(result['touched_share'])} of the frame")
    print(f"elsewhere {show(result['elsewhere']).strip()} dB (away from the program's mask too: {show(result['elsewhere_untouched']).strip()} dB)   "
          f"instrument painted {result['instrument_painted_px']} px = {pct(result['instrument_painted_share'])}")
    print(f"jitter {show(jitter).strip()} (the truth's own {show(result['jitter_of_truth']).strip()})   of touched: light field {pct(result['from_light_field'])}, "
          f"recent {pct(result['from_recent'])}, made up {pct(result['made_up'])}, left {pct(result['left'])}")
    if a.per_frame:
        result["per_frame"] = frames
        print("worst frames (by squared texture error in the mask):")
        for f in sorted(frames, key=lambda f: -f["error"])[:10]:
            print(f"  {f['frame']:4d}  texture {show(f['texture_psnr']).strip()}  SSIM {show(f['ssim'], '{:.3f}')}  plain {show(f['plain_psnr']).strip()}  "
                  f"specular {f['specular']:.2%}  recall {f['recall']:.1%}  false {f['false']:.3%}")
    if a.strip and worst is not None:
        _, k, seen, out, clean = worst
        diff = np.clip(np.abs(out.astype(int) - clean) * 4, 0, 255).astype(np.uint8)
        cv2.imwrite(a.strip, np.hstack([seen, out, clean, diff])[..., ::-1])
        print(f"frame {k}: input | output | truth | 4 x difference -> {a.strip}")
    if a.json:
        pathlib.Path(a.json).write_text(json.dumps(result, indent=1))
    else:
        print(json.dumps({k: v for k, v in result.items() if k not in ("per_frame",)}))


if __name__ == "__main__":
    main()
