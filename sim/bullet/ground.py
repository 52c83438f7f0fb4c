"""Collision shapes of the terrains."""

from __future__ import annotations

from sim.bullet.engine import Engine
from sim.terrain import HeightField, Plane, Slope, Steps, Terrain

Triple = tuple[float, float, float]
UP: Triple = (0.0, 0.0, 1.0)


class Ground:
    """The bodies that do not move."""

    def __init__(self, engine: Engine, terrain: Terrain) -> None:
        """Build ``terrain`` in an empty simulation."""
        self._bullet, self._client = engine.bullet, engine.client
        # nobody looks, but without a shape to be seen PyBullet makes one of the collision shape: 8 ms a height field
        self._seen: int = self._bullet.createVisualShape(
            self._bullet.GEOM_BOX, halfExtents=(1e-3, 1e-3, 1e-3), physicsClientId=self._client
        )
        self._bodies = self._build(terrain)

    def rub(self, friction: float) -> None:
        """Give the whole ground this coefficient of friction."""
        for body in self._bodies:
            self._bullet.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=self._client)

    def _build(self, terrain: Terrain) -> list[int]:
        match terrain:
            case Plane():
                return [self._plane()]
            case Slope():
                return [self._plane(terrain.normal)]
            case Steps():
                return [self._plane(), *(self._step(terrain, step) for step in range(terrain.count))]
            case HeightField():
                return [self._height_field(terrain), self._plane(height=-terrain.amplitude)]

    def _plane(self, normal: Triple = UP, height: float = 0.0) -> int:
        shape = self._bullet.createCollisionShape(
            self._bullet.GEOM_PLANE, planeNormal=normal, physicsClientId=self._client
        )
        return self._static(shape, (0.0, 0.0, height))

    def _step(self, steps: Steps, index: int) -> int:
        """One stair: a box from its rise to the end of the platform."""
        length = steps.end - steps.start - index * steps.depth
        half = (length / 2, steps.width / 2, steps.height / 2)
        shape = self._bullet.createCollisionShape(self._bullet.GEOM_BOX, halfExtents=half, physicsClientId=self._client)
        return self._static(shape, (steps.end - length / 2, 0.0, (index + 0.5) * steps.height))

    def _height_field(self, field: HeightField) -> int:
        nodes = field.cells + 1
        shape = self._bullet.createCollisionShape(
            self._bullet.GEOM_HEIGHTFIELD,
            meshScale=(field.spacing, field.spacing, 1.0),
            heightfieldData=field.heights.ravel().tolist(),
            numHeightfieldRows=nodes,
            numHeightfieldColumns=nodes,
            physicsClientId=self._client,
        )
        middle = (float(field.heights.min()) + float(field.heights.max())) / 2  # the engine centres the shape on it
        return self._static(shape, (0.0, 0.0, middle))

    def _static(self, shape: int, position: Triple) -> int:
        body: int = self._bullet.createMultiBody(
            0.0, shape, self._seen, basePosition=position, physicsClientId=self._client
        )
        return body
