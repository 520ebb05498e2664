"""Three-dimensional pictures without OpenGL: sphere splats with a depth buffer, in numpy.

Plainer than VTK (no ambient occlusion, jagged edges), for machines where nothing can be installed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .camera import LIGHTS, Camera, light_directions
from .cloud import Skin, visible
from .ground import BACKGROUND, Ground
from .requires import require
from .shapes import Array, Samples, Shape, sample_triangles, surface_samples

SKIN_SAMPLES = 150_000
"""Number of discs that draw the surfaces of a picture."""
AMBIENT, DIFFUSE = 0.36, 0.85


def lit(color: Array, normals: Array, camera: Camera) -> Array:
    """Colours [N, 3], or one [3], on a surface with unit normals [N, 3] under the lights of a camera."""
    lights = zip(light_directions(camera), LIGHTS, strict=True)
    strength = AMBIENT + sum(DIFFUSE * power * np.maximum(normals @ towards, 0) for towards, power in lights)
    return np.asarray(color * np.asarray(strength)[:, None])


def _screened(samples: Samples, opacity: float) -> Samples:
    """Stipple that covers a share `opacity` of the samples."""
    kept = np.arange(len(samples.points)) * 0.618034 % 1 < opacity
    return Samples(samples.points[kept], samples.normals[kept], samples.radius)


def _skin_samples(skin: Skin, count: int) -> tuple[Samples, Array]:
    """Discs on a surface with its smooth normals, and their colours [N, 3]."""
    face, weights, radius = sample_triangles(skin.vertices[skin.faces], count)
    corners = skin.faces[face]
    points, normals, rgb = (
        np.einsum("nk,nkd->nd", weights, values[corners]) for values in (skin.vertices, skin.normals, skin.colors)
    )
    return Samples(points, normals, radius), rgb


class SoftwareScene:
    """Same interface as `Scene3D`; a `style` of "surface" is drawn as particles."""

    def __init__(self, camera: Camera, ground: Ground | None, bounds: tuple[Array, Array]) -> None:
        self.camera, self.ground, self.bounds = camera, ground, bounds

    def draw(
        self,
        x: Array,
        rgb: Array,
        radius: float,
        style: str,
        obstacles: Sequence[Shape],
        skins: Sequence[Skin] = (),
    ) -> Array:
        """The picture, uint8 [H, W, 3], of finite positions x [P, 3] m with colours uint8 [P, 3], and of surfaces."""
        samples = [_screened(surface_samples(o, count=40_000), o.opacity) for o in obstacles]
        tint = [np.tile(np.array(o.color) * 255, (len(s.points), 1)) for o, s in zip(obstacles, samples, strict=True)]
        for skin in skins:
            discs, colors = _skin_samples(skin, SKIN_SAMPLES // len(skins))
            samples.append(discs)
            tint.append(colors)
        spread = [np.full(len(x), radius), *(np.full(len(s.points), s.radius) for s in samples)]
        image = self.backdrop(np.concatenate([x, *(s.points for s in samples)]), np.concatenate(spread))
        seen = visible(x, 2 * radius) if len(x) else np.zeros(0, dtype=bool)
        # Samples of a surface are flat discs with its normal, a little larger than their share so that they overlap.
        points = np.concatenate([x[seen], *(s.points for s in samples)])
        radii = np.concatenate(
            [np.full(int(seen.sum()), radius), *(np.full(len(s.points), 1.3 * s.radius) for s in samples)]
        )
        normals = np.concatenate([np.zeros((int(seen.sum()), 3)), *(s.normals for s in samples)])
        self._splat(image, points, radii, np.concatenate([rgb[seen], *tint]), normals)
        return image

    def backdrop(self, points: Array, radii: Array) -> Array:
        """The ground with the shadows of spheres at points [N, 3] with radii [N] [m], and the outline of the bounds,
        uint8 [H, W, 3].
        """
        if self.ground is None:
            image = np.empty((*self.camera.resolution[::-1], 3), dtype=np.uint8)
            image[:] = (BACKGROUND * 255).round()
        else:
            image = self._ground_pixels(self.ground.texture(points, radii))
        return self._outline(image)

    def close(self) -> None:
        """Nothing to release."""

    def _splat(self, image: Array, points: Array, radii: Array, rgb: Array, normals: Array) -> None:
        width, height = self.camera.resolution
        column, row, depth = self.camera.project(points).T
        focal = 0.5 * height / np.tan(0.5 * np.radians(self.camera.view_angle))
        front = depth > 0.01 * np.max(depth, initial=1e-9)
        size = np.maximum(focal * radii / np.where(front, depth, 1), 0.5)
        flat = np.any(normals != 0, axis=1)
        reach = int(np.ceil(min(float(np.max(size[front], initial=0.0)), 0.1 * height)))
        farthest = float(np.max(depth, initial=1e-9)) * 1.01
        nearest = np.full(width * height, np.iinfo(np.int64).max)
        left, top = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
        for dy in range(-reach, reach + 1):
            for dx in range(-reach, reach + 1):
                u, v = (left + dx + 0.5 - column) / size, (top + dy + 0.5 - row) / size
                bulge = 1 - u * u - v * v
                i, j = top + dy, left + dx
                hit = np.nonzero(front & (bulge >= 0) & (i >= 0) & (i < height) & (j >= 0) & (j < width))[0]
                z = depth[hit] - np.where(flat[hit], 0, radii[hit] * np.sqrt(bulge[hit]))
                # Depth in the high bits, particle in the low ones: the smallest key is the nearest particle.
                key = ((np.clip(z / farthest, 0, 1) * (2**30)).astype(np.int64) << 32) | hit
                np.minimum.at(nearest, i[hit] * width + j[hit], key)
        pixel = np.nonzero(nearest != np.iinfo(np.int64).max)[0]
        owner = nearest[pixel] & 0xFFFFFFFF
        u = (pixel % width + 0.5 - column[owner]) / size[owner]
        v = (pixel // width + 0.5 - row[owner]) / size[owner]
        bulge = np.sqrt(np.maximum(1 - u * u - v * v, 0))
        camera = self.camera
        round_normal = u[:, None] * camera.right - v[:, None] * camera.up - bulge[:, None] * camera.forward
        normal = np.where(flat[owner][:, None], normals[owner], round_normal)
        normal = np.where((normal @ camera.forward > 0)[:, None], -normal, normal)
        image.reshape(-1, 3)[pixel] = lit(rgb[owner], normal, camera).clip(0, 255).astype(np.uint8)

    def _ground_pixels(self, texture: Array) -> Array:
        """Intersection of each pixel's ray with the ground, and the texture there; elsewhere the background."""
        assert self.ground is not None
        width, height = self.camera.resolution
        tan = np.tan(0.5 * np.radians(self.camera.view_angle)) * 2 / height
        x = (np.arange(width) + 0.5 - 0.5 * width)[None, :, None] * tan
        y = (0.5 * height - np.arange(height) - 0.5)[:, None, None] * tan
        ray = self.camera.forward + x * self.camera.right + y * self.camera.up
        slope = ray @ self.ground.up
        distance = (self.ground.level - self.camera.position @ self.ground.up) / np.where(slope < 0, slope, -1e-9)
        foot = self.camera.position + distance[..., None] * ray - self.ground.origin
        n = len(texture)
        i = ((foot @ self.ground.front / self.ground.half + 1) * 0.5 * n).clip(-1, n)
        j = ((foot @ self.ground.side / self.ground.half + 1) * 0.5 * n).clip(-1, n)
        hit = (slope < 0) & (i >= 0) & (i < n) & (j >= 0) & (j < n)
        image = np.empty((height, width, 3), dtype=np.uint8)
        image[:] = (BACKGROUND * 255).round()
        image[hit] = texture[i[hit].astype(np.int64), j[hit].astype(np.int64)]
        return image

    def _outline(self, image: Array) -> Array:
        corners = np.array([[self.bounds[i >> k & 1][k] for k in range(3)] for i in range(8)])
        at = self.camera.project(corners)[:, :2]
        pil = require("PIL.Image").fromarray(image)
        pen = require("PIL.ImageDraw").Draw(pil)
        for i in range(8):
            for k in range(3):
                if not i >> k & 1:
                    pen.line([tuple(at[i]), tuple(at[i | 1 << k])], fill=(140, 145, 153), width=1)
        return np.array(pil)
