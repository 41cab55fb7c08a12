"""Each setting, typed with a value that is not its default,
is found wherever a run states its settings.
"""

import json
import shlex
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from shutil import rmtree
from typing import Any

import msgspec
import pytest
from another_program import Line, answered, write
from evaluating import A_TENTH, same_decisions, spec_of
from misbehaving import Asked, completion, serving, tokens_of
from msgspec import structs

from harness.core.errors import UserError
from harness.core.extensions import extensions
from harness.core.work import working
from harness.dataset.load import Dataset
from harness.evaluate.lifecycle import begin, unfinished
from harness.runs.formats import BESIDE, gathered
from harness.runs.settings import (
    PLAIN,
    WORLDS,
    Option,
    Settings,
    changed,
    kind_of,
    of_words,
    options,
    words,
)

Said = tuple[int, str, str]
CARD = """engine = "openai"
description = "thinks where it is asked to"
weights = "m"
thinking = "switch"
[server]
base_url = "http://127.0.0.1:1/v1"
kind = "llama-server"
[latency]
source = "paper"
basis = "none"
"""
RUNS = {
    "rules": "eval --model proxy-faulty --prompt v4 --dataset {small} "
    "--limit 3 --seeds 3,7 --condition 6g:tau=0.5 --sums divide --batch-size 3 --latency ego=0.2,helper=0.1,fusion=0.3 --ask all --ties first "
    "--tag night",
    "counterparts": "eval --dataset {two} --condition 6g:tau=0.5 --control shuffled-messages "
    "--attack liar:share=1/3",
    "selected": "eval --dataset {small} --only 0:3 --danger left --sample 1 --sample-seed 3",
    "narrow": "eval --dataset {two} --condition single-local --until-width 99",
    "decided": "eval --dataset {two} --condition single-local "
    "--seeds 0,1 --until-decided {two_run}",
    "server": "eval --model mine --prompt v4 --dataset {two} --limit 1 --condition 6g --thinking "
    "--temperature 0.5 --sampling-seed 3 --server {server}",
    "helpers": "eval --model mine --prompt v4 --dataset {two} --limit 1 --condition 6g --thinking "
    "--helper-model mine,mine --helper-prompt v2 --helper-answer constrained --no-helper-thinking "
    "--server {server}",
    "device": "eval --model mine --dataset {two} --limit 1 --condition 6g --server {server} "
    "--device-profile agx-orin --device-model qwen3-4b",
    "file": "eval --model theirs --prompt v1 --dataset {two} --limit 1 --condition single-local "
    "--answers answers.jsonl",
    "driven": "drive --scenario {scenario} --condition single-local "
    "--episodes 1 --first-seed 7 --seeds 3,7",
    "driven selected": "drive --scenario {scenario} --condition single-local "
    "--episodes 6 --sample 1 --sample-seed 3 --seeds 3,7",
    "driven until narrow": "drive --scenario {scenario} --episodes 1 --condition single-local "
    "--until-width 99",
    "driven until decided": "drive --scenario {scenario} --episodes 1 --condition single-local "
    "--until-decided other",
    "engine": "eval --model swarm-tiny --engine transformers --dataset {two} --limit 1 "
    "--condition single-local --device cpu --dtype bfloat16 --answer readout --letters cyclic "
    "--flip",
    "picture": "eval --model swarm-tiny-vl --prompt v8 --dataset "
    "{two} --limit 1 --condition single-local "
    "--image blank",
}
# whose settings they have
OF_EXTENSIONS = {
    "device": ("devices",),
    "counterparts": ("controls", "trust"),
    "helpers": ("mixed_helpers",),
    "selected": ("selection",),
    "driven selected": ("selection",),
    "narrow": ("early_stop",),
    "decided": ("early_stop",),
    "driven until narrow": ("early_stop",),
    "driven until decided": ("early_stop",),
}
for run, names in OF_EXTENSIONS.items():
    if not {*names} <= extensions().keys():
        del RUNS[run]
NEEDS = {"engine": "torch", "picture": "llama_cpp"}
SCENARIO = "occluded-intersection:limits=1,perception=1,witnesses=any,radio_share=0.0"
# A run states its conditions by name, and its engine with its model.
IN_OTHER_WORDS: dict[str, dict[str, Any]] = {
    "counterparts": {
        "condition": [
            "6g:tau=0.5",
            "6g:tau=0.5,messages=shuffled",
            "6g:tau=0.5,attack=liar:share=1/3",
        ],
        "control": [],
        "attack": [],
    },
    "engine": {"model": "swarm-tiny:transformers", "engine": None},
}


def answer(asked: Asked) -> None:
    """Answer by the seed of the sampling, and think where that is asked for."""
    share = 0.1 + 0.01 * (asked.body.get("seed", 0) % 80)
    p = f'{{"SLOWER":{0.9 - share:.2f},"IDLE":0.10,"FASTER":{share:.2f}}}'
    helper = '"evidence":"","risk":"low",' if "evidence" in json.dumps(asked.body) else ""
    thinks = asked.body["chat_template_kwargs"]["enable_thinking"]
    said = f'{{{helper}"action_distribution":{p}}}'
    reply = completion(said, **({"reasoning_content": "Who comes?"} if thinks else {}))
    reply["usage"]["prompt_tokens"] = tokens_of(asked)
    asked.reply(reply)


def unusual(settings: Settings) -> Iterator[Option]:
    """The options whose value is not the default."""
    return (each for each in options(type(settings.world)) if each.of(settings) != each.default)


def settings_of(run: str) -> Settings:
    """The settings that a run's command has, whatever its folders are called."""
    return of_words(["harness", *shlex.split(RUNS[run])])


def test_each_setting_is_typed_in_some_run() -> None:
    tried = {
        (kind_of(settings_of(run)), each.path) for run in RUNS for each in unusual(settings_of(run))
    }
    for kind, world in WORLDS.items():
        for each in options(world):
            kinds = {kind} if each.path[0] == "world" else WORLDS.keys()
            assert any((its, each.path) in tried for its in kinds), (
                f"add a run with an unusual {each.flag}"
            )


# What is driven is until it is narrow or decided as what is frozen is.
RARE = (*NEEDS, "driven until narrow", "driven until decided")
MARKS = {run: pytest.mark.exhaustive if run in RARE else pytest.mark.slow for run in RUNS}


@pytest.mark.parametrize("run", [pytest.param(run, marks=mark) for run, mark in MARKS.items()])
def test_a_run_states_each_setting_and_repeats_it(
    run: str, harness: Callable[..., Said], small_path: Path, two_path: Path, two_run: Path
) -> None:
    pytest.importorskip(NEEDS.get(run, "harness"))
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    Path("models/mine.toml").write_text(CARD)
    places = {"small": small_path, "two": two_path, "two_run": two_run, "scenario": SCENARIO}
    with serving(answer) as there:
        typed = shlex.split(RUNS[run].format(**places, server=there.url))
        beside = ["--server", there.url] if there.url in typed else []
        silent = (
            "--quiet",
            "--no-cache",
            *(["--workers", "1"] if "drive" in typed else []),
            "--out",
        )
        if "--answers" in typed:
            beside = ["--answers", "answers.jsonl"]
            write(Path("answers.jsonl"), lines := list[Line]())
            while harness(*typed, *silent, "run")[0] == 3:
                lines += answered(Path("run"))
                write(Path("answers.jsonl"), lines)
            rmtree("run")
        if "other" in typed:
            assert harness(*typed[:-2], "--model", "cruise", *silent, "other")[0] == 0
        code, _, error = harness(*typed, *silent, "run")
        assert code == 0, error
        code, _, error = harness(typed[0], "run", *beside, *silent, "again")
        assert code == 0, error
    asked, [by_run, by_again] = of_words(["harness", *typed]), map(stated, ("run", "again"))
    expected = changed(asked, IN_OTHER_WORDS.get(run, {}))
    for each in unusual(expected):
        for place, settings in by_run.items():
            assert each.of(settings) == each.of(expected), f"{each.flag} in {place}"
    assert by_again == by_run
    assert same_decisions(Path("run"), Path("again"))


@pytest.mark.parametrize("name", PLAIN)
def test_a_stopped_run_resumes_with_each_setting_as_it_was(
    name: str, small: Dataset, tmp_path: Path
) -> None:
    """Of those that open nothing; `test_run_killed.py` changes what is opened."""
    typed = (settings_of(run) for run in RUNS)
    other = next(each.of(of) for of in typed for each in unusual(of) if each.name == name)
    spec = spec_of(small)
    before = changed(spec.settings, {name: other})
    start = begin(spec, tmp_path / "run", None, {}, A_TENTH)
    table = msgspec.to_builtins(before)
    beside = {key: table[of] for key, of in BESIDE.items()}
    record = {**start.settings, **beside, "settings": table}
    with working(tmp_path / "run", structs.replace(start, settings=record, command=words(before))):
        pass
    flag = "--" + name.replace("_", "-")
    with pytest.raises(UserError, match=f"was begun with {flag} .*, and not with (no )?{flag}"):
        unfinished(spec, tmp_path / "run")


def stated(run: str) -> dict[str, Settings]:
    """The settings of a run by the place that states them."""
    manifest = json.loads(Path(run, "run.json").read_text())
    *command, flag, out = shlex.split(manifest["command"])
    assert (flag, out) == ("--out", run)
    text = Path(run, "run.toml").read_text()
    return {
        "run.json": msgspec.convert(gathered(manifest["settings"]), Settings),
        "run.toml": msgspec.convert(gathered(tomllib.loads(text)), Settings),
        "command": of_words(command),
    }
