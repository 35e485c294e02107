"""Mitsuba 3 renders a frame: diffuse and specular light apart, tool mask, depth.  Rays follow the distorted camera."""
import os

import numpy as np

# LLVM 14 cannot compile Dr.Jit's kernels (fmaximum); 19 can.
os.environ.setdefault("DRJIT_LIBLLVM_PATH", "/usr/lib/x86_64-linux-gnu/libLLVM-19.so")
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import drjit as dr

import scene as sc

W, H, SPP = 960, 540, 4
FX, FY, CX, CY = 803.6, 801.9, 487.3, 262.8
DISTORTION = np.array([-0.251, 0.083, 0.00031, -0.00027, 0.0])
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]])

LAMPS = (((5.1, 1.3, -0.6), 1.0), ((-4.2, 2.9, -0.6), 0.8))       # camera frame (mm), share of the light
ALPHA_FILM, ALPHA_LOBE = 0.10, 0.12
FILM_GAIN, LOBE_GAIN = 1.9, 0.4
SLOPE_COARSE, SLOPE_FINE = 0.03, 0.011
DRY = 0.68                    # wetness below which there is hardly a film


def undistorted_rays(u, v):
    """Pixel positions of the distorted picture -> normalised image coordinates, by Newton-like iteration."""
    k1, k2, p1, p2, k3 = DISTORTION
    xd, yd = (u - CX) / FX, (v - CY) / FY
    x, y = xd.copy(), yd.copy()
    for _ in range(30):
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x, y = (xd - dx) / radial, (yd - dy) / radial
    return x, y


def tool_mesh(radius=2.3, length=160.0, around=48):
    """A rod along +z with a round end at the origin."""
    rings = [(0.02 * radius, 0.0)]
    for a in np.linspace(0.1, 1, 10) * np.pi / 2:
        rings.append((radius * np.sin(a), radius * (1 - np.cos(a))))
    for z in (12.0, 12.001, 12.8, 12.801, 40.0, 90.0, length):      # a shallow groove at 12 mm
        rings.append((radius * (0.86 if 12.0005 < z < 12.8005 else 1.0), z))
    phi = np.linspace(0, 2 * np.pi, around, endpoint=False)
    p = np.array([[(r * np.cos(f), r * np.sin(f), z) for f in phi] for r, z in rings]).reshape(-1, 3)
    faces = []
    for i in range(len(rings) - 1):
        for j in range(around):
            a, b = i * around + j, i * around + (j + 1) % around
            faces += [(a, b, a + around), (b, b + around, a + around)]
    return p.astype(np.float32), np.array(faces, np.uint32)


def make_mesh(name, vertices, faces, normals=None, uv=None):
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=normals is not None, has_vertex_texcoords=uv is not None)
    p = mi.traverse(mesh)
    p["vertex_positions"], p["faces"] = vertices.ravel(), faces.ravel()
    if normals is not None:
        p["vertex_normals"] = normals.ravel()
    if uv is not None:
        p["vertex_texcoords"] = uv.astype(np.float32).ravel()
    p.update()
    return mesh


class Renderer:
    def __init__(self, tissue, seed, with_tool=False):
        self.tissue = tissue
        v, n = tissue.vertices()
        parts = {"type": "scene", "tissue": make_mesh("tissue", v, tissue.faces, n, tissue.uv.reshape(-1, 2))}
        self.with_tool = with_tool
        if with_tool:
            self.tool_v, faces = tool_mesh()
            parts["tool"] = make_mesh("tool", self.tool_v + 1e4, faces, self._tool_normals(self.tool_v, faces))
            self.tool_n = self._tool_normals(self.tool_v, faces)
        self.scene = mi.load_dict(parts)
        self.params = mi.traverse(self.scene)
        self.keys = {part: [next(k for k in self.params.keys() if k.startswith(part) and k.endswith(w))
                            for w in ("vertex_positions", "vertex_normals")] for part in parts if part != "type"}
        self.tool_shape = next((s for s in self.scene.shapes() if s.id() == "tool"), None)
        self.albedo = mi.Texture2f16(mi.TensorXf16(tissue.albedo), wrap_mode=dr.WrapMode.Clamp) if hasattr(mi, "Texture2f16") else \
            mi.Texture2f(mi.TensorXf(tissue.albedo.astype(np.float32)), wrap_mode=dr.WrapMode.Clamp)
        self.film = mi.Texture2f(mi.TensorXf(tissue.film), wrap_mode=dr.WrapMode.Repeat)
        self.film_facets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, ALPHA_FILM)
        self.lobe_facets = mi.MicrofacetDistribution(mi.MicrofacetType.Beckmann, ALPHA_LOBE)
        self.steel = mi.load_dict({"type": "roughconductor", "material": "Cr", "distribution": "ggx", "alpha": 0.13})
        # fixed stratified samples, another jitter in each pixel
        rng = np.random.default_rng(seed)
        px, py = np.meshgrid(np.arange(W), np.arange(H))
        cell = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
        su = px[..., None] - 0.5 + (cell[:, 0] + rng.random((H, W, SPP))) / 2
        sv = py[..., None] - 0.5 + (cell[:, 1] + rng.random((H, W, SPP))) / 2
        x, y = undistorted_rays(su.ravel(), sv.ravel())
        self.dx, self.dy = mi.Float(x.astype(np.float32)), mi.Float(y.astype(np.float32))
        dr.eval(self.dx, self.dy)

    @staticmethod
    def _tool_normals(v, faces):
        n = np.zeros_like(v)
        t = np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]])
        for k in range(3):
            np.add.at(n, faces[:, k], t)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        outward = np.sign((n[:, :2] * v[:, :2]).sum(1, keepdims=True) + 1e-9)
        return (n * outward).astype(np.float32)

    def move(self, breath_mm=0.0, heart_mm=0.0, tool_pose=None, deform=True):
        if deform:
            v, n = self.tissue.vertices(breath_mm, heart_mm)
            kv, kn = self.keys["tissue"]
            self.params[kv], self.params[kn] = v.ravel(), n.ravel()
        if self.with_tool:
            kv, kn = self.keys["tool"]
            v, n = (self.tool_v + 1e4, self.tool_n) if tool_pose is None else \
                (self.tool_v @ tool_pose[:3, :3].T + tool_pose[:3, 3], self.tool_n @ tool_pose[:3, :3].T)
            self.params[kv], self.params[kn] = v.astype(np.float32).ravel(), n.astype(np.float32).ravel()
        if deform or self.with_tool:
            self.params.update()

    def frame(self, scene_from_camera):
        """-> diffuse, specular, tool light (H, W, 3 each, linear), tool share (H, W), depth along z (H, W)."""
        m = scene_from_camera.astype(np.float32)
        value = lambda x: dr.opaque(mi.Float, float(x))
        R = [[value(m[i, j]) for j in range(3)] for i in range(3)]
        o = mi.Point3f(*[value(m[i, 3]) for i in range(3)])
        turn = lambda x, y, z: mi.Vector3f(*[R[i][0] * x + R[i][1] * y + R[i][2] * z for i in range(3)])
        d = dr.normalize(turn(self.dx, self.dy, 1.0))
        si = self.scene.ray_intersect(mi.Ray3f(mi.Point3f(o), d), mi.RayFlags.All, True)
        hit = si.is_valid()
        tool = (si.shape == mi.ShapePtr(self.tool_shape)) & hit if self.with_tool else mi.Bool(False)
        tissue = hit & ~tool
        n = si.sh_frame.n
        n = dr.select(dr.dot(n, d) > 0, -n, n)
        base = mi.Frame3f(n)
        tex = self.albedo.eval(si.uv, active=tissue)
        color, wet = mi.Color3f(tex[0], tex[1], tex[2]), mi.Float(tex[3])
        slope = self.film.eval(si.uv * (2 * sc.HALF / sc.FILM_MM), active=tissue)
        t = dr.normalize(mi.Vector3f(1, 0, 0) - n * n.x)
        b = dr.cross(n, t)
        coarse, fine = SLOPE_COARSE * (0.4 + 0.6 * wet), SLOPE_FINE * wet
        film = 0.015 + 0.985 * dr.square(dr.clip((wet - DRY) / (1 - DRY), 0, 1)) * (3 - 2 * dr.clip((wet - DRY) / (1 - DRY), 0, 1))
        gx, gy = coarse * slope[0] + fine * slope[2], coarse * slope[1] + fine * slope[3]
        tilt = lambda k: mi.Frame3f(dr.normalize(n - t * (k * gx) - b * (k * gy)))
        film_frame, lobe_frame, skin_frame = tilt(1.0), tilt(0.3), tilt(0.18)
        diffuse, specular, steel = mi.Color3f(0), mi.Color3f(0), mi.Color3f(0)
        ctx = mi.BSDFContext()
        axis = turn(0.0, 0.0, 1.0)

        def bsdf(material, frame, wo, active):
            s = mi.SurfaceInteraction3f(si)
            s.sh_frame = frame
            s.wi = frame.to_local(-d)
            lo = frame.to_local(wo)
            up = active & (mi.Frame3f.cos_theta(s.wi) > 0) & (mi.Frame3f.cos_theta(lo) > 0)
            return dr.select(up, material.eval(ctx, s, lo, up), 0)

        def facets(distribution, frame, wo, half):
            """D G / (4 cos_i): the reflected part of a rough dielectric without its Fresnel term."""
            i, o_, h = frame.to_local(-d), frame.to_local(wo), frame.to_local(half)
            up = (i.z > 1e-3) & (o_.z > 1e-3)
            return dr.select(up, distribution.eval(h) * distribution.G(i, o_, h) / (4 * i.z), 0)

        # two of the four samples see one lamp, two the other, each with twice its light
        cell = dr.arange(mi.UInt32, W * H * SPP) % 4
        first_lamp = (cell == 0) | (cell == 3)
        pick = lambda a, b: dr.select(first_lamp, mi.Float(a), mi.Float(b))
        (pa, power_a), (pb, power_b) = LAMPS
        lamp = o + turn(*[pick(u, v) for u, v in zip(pa, pb)])
        power = 2 * pick(power_a, power_b)
        to = lamp - si.p
        dist2 = dr.squared_norm(to)
        wo = to * dr.rsqrt(dist2)
        lit = hit & ~self.scene.ray_test(si.spawn_ray_to(lamp), hit)
        away = dr.maximum(-dr.dot(wo, axis), 0)
        e = dr.select(lit, power * 4200.0 / dist2 * away * dr.sqrt(away), 0)
        cos = dr.maximum(dr.dot(skin_frame.n, wo), 0)
        diffuse += dr.select(tissue, color * (cos * e * dr.inv_pi), 0)
        half = dr.normalize(wo - d)
        fresnel = mi.fresnel(dr.dot(half, wo), 1.38)[0]
        gloss = film * FILM_GAIN * facets(self.film_facets, film_frame, wo, half) + film * LOBE_GAIN * facets(self.lobe_facets, lobe_frame, wo, half)
        specular += dr.select(tissue, gloss * fresnel * e, 0)
        if self.with_tool:
            steel += (bsdf(self.steel, base, wo, tool) + 0.10 * dr.inv_pi * dr.maximum(dr.dot(n, wo), 0)) * dr.select(tool, e, 0)
        sky = 0.045 * (0.6 + 0.4 * n.z)
        diffuse += dr.select(tissue, color * sky, 0)
        if self.with_tool:
            steel += dr.select(tool, 0.02 + 0.02 * n.z, 0)
        depth = dr.select(hit, dr.dot(si.p - o, axis), 0)
        samples = [*diffuse, *specular, *steel, dr.select(tool, mi.Float(1), 0)]
        dr.eval(samples, depth)                    # one kernel for all; summing first would run it once per plane
        planes = [dr.block_sum(x, SPP) / SPP for x in samples]
        first = dr.gather(mi.Float, depth, dr.arange(mi.UInt32, W * H) * SPP)
        dr.eval(planes, first)
        out = [np.array(p).reshape(H, W) if dr.width(p) > 1 else np.zeros((H, W), np.float32) for p in planes]
        stack = lambda k: np.stack(out[k:k + 3], -1)
        return stack(0), stack(3), stack(6), out[9], np.array(first).reshape(H, W)
