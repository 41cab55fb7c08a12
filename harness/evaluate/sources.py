"""Collect the files that an evaluation is made of, for its run to keep."""

from pathlib import Path

import msgspec

from harness.backends import cards
from harness.coordination.operating_point import kept_of
from harness.coordination.schedules import SCHEDULES
from harness.core import resources
from harness.core.files import bytes_of
from harness.evaluate.spec import Spec
from harness.prompts.answer_schema import ROLES, answer_schema
from harness.radio.profiles import CHANNELS


def sources(spec: Spec) -> dict[str, bytes]:
    """Return the content of the files that an evaluation is made of, by their path in a project.

    They are prompts, answer schemas, cards (models' descriptions), channels, networks, schedules
    and a timer's. What is in no file, such as the card of a hub id or a package's channel, only
    `run.json` has.
    """
    texts: dict[str, bytes] = {}
    paths: dict[str, Path | None] = {}
    for agent in spec.agents:
        prompt = agent.prompt
        for name, text in prompt.files.items():
            texts[f"prompts/{prompt.version}/{name}"] = text.encode()
        for role in ROLES:
            schema = msgspec.json.encode(
                answer_schema(**prompt.shape(role, spec.actions)._asdict())
            )
            texts[f"schemas/{prompt.version}/{role}.json"] = (
                msgspec.json.format(schema, indent=1) + b"\n"
            )
        card = agent.card.name.partition(":")[0]
        if card in cards.names() and cards.load(agent.card.name) == agent.card:
            paths[f"models/{card}.toml"] = resources.find("models", f"{card}.toml")
    for point in spec.points:
        if point.radio.profile:
            paths |= {
                f"channels/{name}": path
                for name, path in CHANNELS.files(point.radio.profile).items()
            }
        if point.network:
            file = f"{point.cloud.round_trip}.toml"
            paths[f"networks/{file}"] = resources.find("networks", file)
        paths[f"schedules/{point.ask.schedule}.toml"] = SCHEDULES.file(point.ask.schedule)
    for folder, by_name in kept_of(spec.points).items():
        paths |= {f"{folder}/{name}.toml": kept.file for name, kept in by_name.items()}
    if spec.timer:
        paths |= spec.timer.files()
    files = {name: bytes_of(path, "text") for name, path in paths.items() if path}
    return dict(sorted((texts | files).items()))
