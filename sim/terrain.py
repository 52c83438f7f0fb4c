"""The ground: pure descriptions that know their own height; ``sim.bullet.ground`` makes collision shapes of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drivers.robot import Array


@dataclass(frozen=True, slots=True)
class Plane:
    """Level ground at z = 0."""

    def height_at(self, x: float, y: float) -> float:
        """Height of the ground under a point of the world, m."""
        return 0.0


@dataclass(frozen=True, slots=True)
class Slope:
    """A tilted plane through the world's origin."""

    angle: float
    """Inclination, rad: positive rises along ``direction``."""
    direction: float = 0.0
    """Heading of steepest ascent, rad about z, 0 = +x."""

    def __post_init__(self) -> None:
        if not abs(self.angle) < math.pi / 3:
            raise ValueError(f"slope angle = {self.angle}: must lie within ±{math.pi / 3:.3f} rad")

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit normal of the plane."""
        sine = math.sin(self.angle)
        return -sine * math.cos(self.direction), -sine * math.sin(self.direction), math.cos(self.angle)

    def height_at(self, x: float, y: float) -> float:
        """Height of the ground under a point of the world, m."""
        return math.tan(self.angle) * (x * math.cos(self.direction) + y * math.sin(self.direction))


@dataclass(frozen=True, slots=True)
class Steps:
    """A staircase along +x that ends on a platform; level ground before it."""

    height: float
    """Rise of one step, m."""
    depth: float = 0.30
    """Tread of one step, m."""
    count: int = 5
    start: float = 0.6
    """Where the first step rises, m."""
    width: float = 4.0
    """Along y, centred on the x axis, m."""
    platform: float = 6.0
    """Length of the last tread, m."""

    def __post_init__(self) -> None:
        for name in ("height", "depth", "count", "width", "platform"):
            if not getattr(self, name) > 0:
                raise ValueError(f"steps {name} = {getattr(self, name)}: must be positive")

    @property
    def end(self) -> float:
        """Where the platform ends, m along x."""
        return self.start + (self.count - 1) * self.depth + self.platform

    def height_at(self, x: float, y: float) -> float:
        """Height of the ground under a point of the world, m."""
        if not self.start <= x <= self.end or abs(y) > self.width / 2:
            return 0.0
        return self.height * min(math.floor((x - self.start) / self.depth) + 1, self.count)


@dataclass(frozen=True)
class HeightField:
    """Uniform random heights on a square lattice, two triangles a cell; level ground at -amplitude around it."""

    amplitude: float
    """Heights lie in ±amplitude, m."""
    spacing: float = 0.10
    """Of the lattice, m."""
    seed: int = 0
    extent: float = 20.0
    """Side of the square, centred on the world's origin, m."""

    def __post_init__(self) -> None:
        if not self.amplitude >= 0:
            raise ValueError(f"height field amplitude = {self.amplitude}: must not be negative")
        if not 0 < self.spacing <= self.extent / 2:
            raise ValueError(
                f"height field spacing = {self.spacing}: must lie in (0, {self.extent / 2}], half the extent"
            )

    @property
    def cells(self) -> int:
        """Cells along a side."""
        return round(self.extent / self.spacing)

    @cached_property
    def heights(self) -> Array:
        """Lattice heights, m. Shape (cells + 1, cells + 1), indexed [y, x] from the corner at -extent/2."""
        nodes = self.cells + 1
        heights = np.random.default_rng(self.seed).uniform(-self.amplitude, self.amplitude, (nodes, nodes))
        heights = heights.astype(np.float32).astype(np.float64)
        heights.setflags(write=False)
        return heights

    def height_at(self, x: float, y: float) -> float:
        """Height of the ground under a point of the world, m."""
        column, row = x / self.spacing + self.cells / 2, y / self.spacing + self.cells / 2
        if not (0 <= column <= self.cells and 0 <= row <= self.cells):
            return -self.amplitude
        i, j = min(int(column), self.cells - 1), min(int(row), self.cells - 1)
        u, v = column - i, row - j
        h00, h10 = self.heights[j, i], self.heights[j, i + 1]
        h01, h11 = self.heights[j + 1, i], self.heights[j + 1, i + 1]
        if u + v <= 1:
            return float(h00 + u * (h10 - h00) + v * (h01 - h00))
        return float(h11 + (1 - u) * (h01 - h11) + (1 - v) * (h10 - h11))


Terrain = Plane | Slope | Steps | HeightField


def resting_height(terrain: Terrain, feet: Array, radius: float) -> float:
    """How far the feet must rise for the first one just to touch the ground, m.

    Args:
        terrain: the ground.
        feet: centres of the feet's spheres, m. Shape (4, 3).
        radius: of the spheres, m; each is sampled on two rings.
    """
    angles = [index * math.pi / 6 for index in range(12)]
    disc = [(0.0, 0.0), *((r * math.cos(a), r * math.sin(a)) for r in (radius / 2, 0.99 * radius) for a in angles)]
    rises: list[float] = [
        terrain.height_at(x + dx, y + dy) + math.sqrt(max(radius**2 - dx**2 - dy**2, 0.0)) - z
        for x, y, z in feet.tolist()
        for dx, dy in disc
    ]
    return max(rises)
