"""A scene graph is one record in memory, the same bytes in a file, and plain data to a template."""

from dataclasses import replace
from functools import cache
from typing import Any

import msgspec
import pytest
from graphs import ACTIONS, CASES, TRUCK, graph

from harness.core.errors import UserError
from harness.core.files import canonical_json
from harness.core.resources import entries
from harness.dataset.load import Dataset, find, load
from harness.dataset.schema import plain_type
from harness.dataset.verify import opened, read_level
from harness.prompts import versions
from harness.world.scene_graph import SceneGraph

NAMES = sorted(manifest.parent.name for manifest in entries("datasets", "*/manifest.json"))


@cache
def first(name: str) -> Dataset:
    return load(find(name), limit=1)


def shown(text: str, seen: SceneGraph) -> str:
    """What a stranger's template makes of a graph."""
    template = f"{{% block system %}}{{% endblock %}}{{% block user %}}{text}{{% endblock %}}"
    prompt = replace(versions.load("v2"), texts=dict.fromkeys(versions.ROLES, template))
    return str(prompt.render(seen, ACTIONS)[1]["content"])


def kinds(value: Any) -> set[type]:
    inner = (
        [*value, *value.values()] if type(value) is dict else value if type(value) is list else []
    )
    return {type(value)}.union(*map(kinds, inner))


@pytest.mark.parametrize("name", NAMES)
def test_a_released_record_that_is_read_is_written_as_it_was(name: str) -> None:
    dataset = first(name)
    kind, tree = plain_type(dataset.scenario), dataset.trees[0]
    with opened(dataset.path) as file:
        for line in (
            line for step in range(len(tree.levels)) for line in read_level(file, tree, step)
        ):
            record = msgspec.json.decode(line, type=kind)
            assert canonical_json(msgspec.to_builtins(record)).encode() == line


@pytest.mark.parametrize("name", NAMES)
def test_a_template_reads_plain_data_alone(name: str) -> None:
    dataset = first(name)
    for scene in dataset.scenes(dataset.courses()):
        for seen in scene.graphs.values():
            assert kinds(seen.plain()) <= {dict, list, str, int, float, bool, type(None)}
            assert msgspec.convert(seen.plain(), type(seen)) == seen


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("occluded-intersection-v2", "False False False False"),
        ("do-not-pass-v1", "True True True True"),
    ],
)
def test_what_is_not_in_the_file_is_undefined_to_a_template(name: str, there: str) -> None:
    dataset = first(name)
    graphs = [g for scene in dataset.scenes(dataset.courses()) for g in scene.graphs.values()]
    seen = next(g for g in graphs if g.conflicts and g.nodes)
    asks = ("self.type", "ego.route", "nodes[0].braking", "conflicts[0].lane")
    assert shown(" ".join(f"{{{{ graph.{member} is defined }}}}" for member in asks), seen) == there


@pytest.mark.parametrize(
    "member", ["blinded", "plain", "seen", "itself", "__class__", "__struct_fields__"]
)
def test_no_member_of_the_class_is_one_of_the_graph(member: str) -> None:
    seen, _ = CASES["ego-occluded"]
    assert shown("{{ graph.viewer }}", seen) == "v1"
    with pytest.raises(UserError, match="does not render"):
        shown(f"{{{{ graph.{member} }}}}", seen)


def test_a_graph_is_a_value() -> None:
    one, other = (graph("ego", [TRUCK], []) for _ in range(2))
    assert one == other
    assert hash(one) == hash(other)
    with pytest.raises(AttributeError):
        one.step = 3
    assert one.blinded().seen == ()
    assert one.blinded().occluded == ("left", "right", "oncoming")
    assert one.seen == ("v4",)
