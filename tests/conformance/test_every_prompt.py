"""What holds for every prompt version that lies in prompts/."""

import pytest
from evaluating import scenes_of

from harness.dataset.load import Dataset
from harness.prompts import versions as prompts


@pytest.mark.parametrize("version", prompts.names())
def test_it_renders_every_graph_of_the_dataset_the_same_each_time(
    version: str, small: Dataset
) -> None:
    prompt = prompts.load(version)
    for scene in scenes_of(small):
        for graph in scene.graphs.values():
            messages = prompt.render(graph, small.actions, (), small.scenario.prompt_words)
            shown = len(prompt.examples.of(graph.role)) if prompt.examples else 0
            assert [m["role"] for m in messages] == [
                "system",
                *["user", "assistant"] * shown,
                "user",
            ]
            assert all(m["content"].strip() for m in messages)
            assert prompt.render(graph, small.actions, (), small.scenario.prompt_words) == messages


@pytest.mark.parametrize("version", prompts.names())
def test_it_tells_every_viewer_the_actions_and_the_form_of_the_answer(
    version: str, small: Dataset
) -> None:
    prompt = prompts.load(version)
    assert prompt.helper_answer in ("distribution", "recommendation")
    for graph in scenes_of(small)[0].graphs.values():
        chat = prompt.render(graph, small.actions, (), small.scenario.prompt_words)
        text = chat[0]["content"] + chat[-1]["content"]
        ego = "maneuver" if prompt.ego_answer == "maneuver" else "distribution"
        form = ego if graph.role == "ego" else prompt.helper_answer
        assert ("action_distribution" in text) == (form == "distribution")
        assert ("recommended_maneuver" in text) == (form == "recommendation")
        assert ('"maneuver"' in text) == (form == "maneuver")
        assert all(action in text for action in small.actions)
