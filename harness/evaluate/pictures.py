"""Choose the picture of a prompt: what the viewer sees,
or a control that tests whether a model looks.
"""

from functools import lru_cache

import numpy as np

from harness.core import noise
from harness.core.errors import UserError
from harness.core.image import Image
from harness.dataset.load import Scene
from harness.evaluate.frozen_world import FrozenSource
from harness.evaluate.spec import Spec
from harness.world.perception.camera import Sight

GREY = 127


def picture(
    spec: Spec, index: int, scene: Scene, viewer: str, pictured: bool = True
) -> Image | None:
    """Return the picture that a vehicle's model is shown of a scene; None if its prompt shows none.

    `index` is the number of the agent (a model with its prompt) that answers, in `spec.agents`, and
    `viewer` the vehicle's id. The picture is grey if `pictured` is false. Raises UserError if it
    must come from another scene and there is none.
    """
    agent = spec.agents[index]
    vision = agent.card.vision
    if not agent.sees or vision is None:
        return None
    if not pictured or agent.image == "blank":
        return blank(vision.size_px)
    if agent.image == "another":
        place = scene.viewers.index(viewer)
        scene = another(spec, scene)
        viewer = scene.viewers[min(place, len(scene.viewers) - 1)]
    of_layout = spec.scenario.at(scene.record.episode_seed)
    return Sight(of_layout, scene.state, viewer, vision.size_px)


@lru_cache(maxsize=4)
def blank(size_px: tuple[int, int]) -> Image:
    """Return a grey picture of a size (width, height) in pixels."""
    width, height = size_px
    return Image(np.full((height, width, 3), GREY, dtype=np.uint8))


def another(spec: Spec, scene: Scene) -> Scene:
    """Return a random scene of another episode, whose picture a control shows in place of the own.

    It is as many decisions into its episode, and always the same for a scene's id. Raises UserError
    if there is none.
    """
    assert isinstance(spec.source, FrozenSource), "Spec refuses another scene in the closed loop"
    dataset = spec.source.dataset
    forest = dataset.forest
    n = forest.place[scene.id]
    candidates = np.flatnonzero((forest.step == forest.step[n]) & (forest.tree != forest.tree[n]))
    if not len(candidates):
        raise UserError(
            f"--image another: no other episode of {dataset.name} has a decision point at step "
            f"{int(forest.step[n])}; give a greater --limit"
        )
    index = int(noise.uniforms((1,), "another picture", scene.id)[0] * len(candidates))
    return dataset.scenes([forest.ids[candidates[index]]])[0]
