"""The world as cameras and robot meet it: pictures of how it lies now, and what becomes of it when the tool comes."""

from binpick import geometry
from binpick.data import Image, Light
from binpick.geometry import Transform
from binpick.settings import Tool
from binpick.sim import exam, score
from binpick.sim.render import Renderer
from binpick.sim.score import Verdict
from binpick.sim.world import World


class Twin:
    """A settled world and its pictures: it renders when it changes, so that a shot only adds exposure and noise."""

    def __init__(self, world: str, kinds: str, parts: int, seed: int) -> None:
        """As `World`. Raises InputError."""
        self._T_bin_base = geometry.inverse(exam.setup(world).T_base_bin)
        self._renderer = Renderer(exam.rig(world), world)
        self._world = World(world, kinds, parts, seed)
        self._scene = self._world.scene()
        self._render()

    @property
    def parts_left(self) -> int:
        """Parts still in the bin."""
        return len(self._scene.parts)

    def image(self, index: int, light: Light, shot: int) -> Image:
        """What a camera's sensor reads out."""
        return self._renderer.expose(self._scene, index, light, shot)

    def move(self, T_base_tcp: Transform, tool: Tool, open_m: float = 0.0, close_m: float = 0.0) -> Verdict:
        """Sends the tool there; a part that it can pick leaves the bin, and the others find their places."""
        verdict = score.judge(self._scene, self._T_bin_base @ T_base_tcp, tool, open_m, close_m)
        if verdict.ok:
            self._world.remove(verdict.part_id)
            self._world.settle()
            self._render()
        return verdict

    def _render(self) -> None:
        """Shows the cameras the world as it is now, with the pattern on as the recipes ask."""
        scene = self._world.scene()
        for index in (0, 1):
            self._renderer.radiance(scene, index, 0)
        self._scene = scene
