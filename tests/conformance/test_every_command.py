"""Every command on hostile copies of all that it takes:
no server asked, no module imported, no secret told.

Each command is run in a stranger's project, once as it is, and once for each hostile value of each
of its parameters: runs, datasets, models, prompts, cards, traces, weights, answers of a server. In
`make test` it is run with one hostile value of each parameter, another at each command. A new
command is covered if its parameters have names that other commands have; else `PLAIN` asks for one
line.
"""

import importlib
import json
import pickle
import secrets
import shutil
import sys
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import pytest
import uvicorn
from evaluating import live_spec_of, spec_of
from evaluating import run as evaluate
from misbehaving import Asked, Server, completion, serving
from starlette.testclient import TestClient

from harness import cli
from harness.coordination.named_points import POINTS
from harness.dataset.load import Dataset, load
from harness.prompts import versions

Said = tuple[int, str, str]
SECRET = "sk-canary-0123456789"
STRANGE = "/stranger"
MODULE = "canary_module"
ENV = f"env:{MODULE}:canary-v0"
TRAFFIC = f'env:merge-v0:config={{"other_vehicles_type":"{MODULE}.Car"}}'
IMPORTED = """
import os, gymnasium
from highway_env.envs import MergeEnv
from highway_env.vehicle.behavior import IDMVehicle

pytestmark = pytest.mark.usefixtures("svg_alone")
open(os.environ["CANARY_FILE"], "a").write("imported\\n")
class Car(IDMVehicle): pass
class Canary(MergeEnv): pass
gymnasium.register("canary-v0", entry_point=Canary)
"""
CARD = """
engine = "openai"
description = "d"
weights = "m"
[server]
base_url = "{url}"
key_env = "{key}"
retries = 0
[latency]
source = "paper"
basis = "b"
"""
TEMPLATE = """{% block system %}{{ task }}{% endblock %}{% block user %}
{% include "../../secret.txt" ignore missing %}{{ self.__init__.__globals__ }}{{ environ }}
{{ cycler.__init__.__globals__.os.environ }}{% endblock %}"""
TRACE = """description = "d"
source = "s"
status = "assumed"
model = "trace"
[parameters]
file = "../../secret.txt"
latency_s = 0.01
"""
EDITION = """
description = "d"
condition = ["single-local", "6g"]
ranked_by = "6g"
seeds = "0:2"
latency = "paper"
ties = "drawn"
metrics = ["success_rate"]
[datasets]
small = "{}"
[prompts]
v2 = "{}"
"""


def commands() -> Iterator[tuple[str, Any]]:
    """Every command of the program with its words."""

    def within(command: Any, words: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        if subcommands := getattr(command, "commands", None):
            for name, each in subcommands.items():
                yield from within(each, (*words, name))
        else:
            yield " ".join(words), command

    yield from within(cli._program(), ())


class Trap:
    """Code in a pickle."""

    def __reduce__(self) -> tuple[Any, ...]:
        return importlib.import_module, (MODULE,)


class Strangers:
    """A stranger's project, in the current folder, with something hostile of each kind in it."""

    def __init__(self, asked: Server, mine: Server, base: Path) -> None:
        shutil.copytree(base, ".", dirs_exist_ok=True)
        Path("swarmdrive.toml").touch()
        for kind in ("models", "channels", "prompts", "reports", "datasets", "editions"):
            Path(kind).mkdir(exist_ok=True)
        self._cards(asked.url, mine.url)
        self._weights()
        shutil.copytree(Path(__file__).parents[2] / "prompts/v2", "prompts/evil")
        for file in Path("prompts/evil").glob("*.j2"):
            file.write_text(TEMPLATE)
        Path("channels/evil.toml").write_text(TRACE)
        Path("evil.json").write_text(json.dumps({"other_vehicles_type": f"{MODULE}.Car"}))
        Path("evil.csv").write_text("distance_m,reception\n1,0.5\n9,0.1\n")
        Path("evil.txt").write_text(f'{{"import": "{MODULE}"}} {{{{ environ }}}} {asked.url}')
        for name, text in SETTINGS.items():
            Path(name).write_text(text.format(url=asked.url))
        self._datasets()
        self._runs(asked.url)

    def _cards(self, theirs: str, mine: str) -> None:
        Path("models/evil.toml").write_text(CARD.format(url=theirs, key="CANARY_SECRET"))
        # A server that the user trusts with a key, and which sends every request elsewhere.
        Path("models/mine.toml").write_text(CARD.format(url=mine, key="OPENAI_API_KEY"))

    def _weights(self) -> None:
        folder = Path("models/evil-weights")
        folder.mkdir()
        own = {"auto_map": {"AutoConfig": f"{MODULE}.C", "AutoModelForCausalLM": f"{MODULE}.M"}}
        for name in ("config.json", "tokenizer.json", "tokenizer_config.json"):
            (folder / name).write_text(json.dumps({"model_type": "own", **own}))
        (folder / "pytorch_model.bin").write_bytes(pickle.dumps(Trap()))

    def _datasets(self) -> None:
        for name, scenario in (("module", ENV), ("traffic", TRAFFIC)):
            shutil.copytree("base/dataset", f"datasets/{name}")
            change(Path(f"datasets/{name}/manifest.json"), scenario=scenario)
        shutil.copytree("base/dataset", "datasets/small")
        small, prompt = load(Path("datasets/small")).sha256, versions.load("v2").sha256
        Path("editions/small.toml").write_text(EDITION.format(small, prompt))

    def _runs(self, url: str) -> None:
        run, driven = Path("base/run"), Path("base/driven")
        stated = json.loads((run / "run.json").read_text())
        served = {
            "base_url": url,
            "kind": "generic",
            "key_env": "CANARY_SECRET",
            "timeout_s": 9.0,
            "retries": 0,
        }
        # The identity is what the canary server would state of itself.
        identity = {
            "engine": "openai",
            "server": "generic",
            "base_url": url,
            "model": "m",
            "listed": {},
        }
        asks = {**stated["model"], "engine": "openai", "weights": "m", "server": served}
        loads = {
            **stated["model"],
            "engine": "transformers",
            "weights": str(Path("models/evil-weights").absolute()),
        }
        folders = {
            "served": {"model": {**asks, "name": "theirs"}, "identity": identity},
            "posing": {"model": {**asks, "name": "proxy"}, "identity": identity},
            "weights": {"model": {**loads, "name": "theirs"}},
            "moved": {
                "world": {**stated["world"], "path": str(Path("datasets/module").absolute())}
            },
            "named": {"world": {**stated["world"], "path": "nowhere", "name": "traffic"}},
        }
        for name, changes in folders.items():
            shutil.copytree(run, f"reports/{name}")
            change(Path(f"reports/{name}/run.json"), **changes)
        world = json.loads((driven / "run.json").read_text())["world"]
        for name, scenario in (("driven", ENV), ("traffic", TRAFFIC)):
            shutil.copytree(driven, f"reports/{name}")
            stated_world = {**world, "scenario": {**world["scenario"], "name": scenario}}
            change(Path(f"reports/{name}/run.json"), world=stated_world)


SETTINGS = {
    "weights.toml": 'model = "models/evil-weights"\n',
    "replay.toml": 'model = "replay:reports/served"\n',
    "server.toml": 'model = "mine"\nserver = ["{url}"]\n',
    "module.toml": '[world]\nkind = "frozen"\ndataset = "datasets/module"\n',
    "driven.toml": f'[world]\nkind = "closed-loop"\nscenario = "{ENV}"\n',
}
RUNS = [
    f"reports/{name}"
    for name in ("served", "posing", "weights", "moved", "named", "driven", "traffic")
]
DATASETS = ["module", "datasets/traffic"]
MODELS = ["evil", "mine", "models/evil-weights", "replay:reports/served", "replay:reports/weights"]
# Hostile values of parameters by name, or by command and name.
HOSTILE: dict[str, Sequence[str]] = {
    "run": RUNS, "runs": RUNS, "a": RUNS, "b": RUNS, "folders": RUNS, "tune": RUNS, "folder": ["reports"],
    "dataset": DATASETS, "model": MODELS, "helper_model": ["evil", "mine"], "prompt": ["evil"],
    "helper_prompt": ["evil"], "version": ["evil"], "condition": ["evil"], "env_config": ["evil.json"],
    "against": ["evil.csv"], "tokenizer": ["models/evil-weights"], "base": ["models/evil-weights"],
    "file": ["evil.txt"], "files": ["evil.txt", "reports/served"], "pilots": RUNS,
    "eval file": list(SETTINGS), "drive file": list(SETTINGS), "names": ["evil"],
    "study grid model": ["proxy,evil", "proxy,models/evil-weights"], "study closed-loop model": ["evil"],
    "with_reaction": DATASETS, "without_reaction": DATASETS, "run history dataset": [],
    "radio show name": ["evil"], "radio check name": ["evil"], "model check name": ["evil", "mine"],
    "model pull name": ["evil"], "prompt compare a": ["evil"], "prompt compare b": ["evil"],
}  # fmt: skip
# What a command needs, and what keeps it short; a folder that it writes is its own each time.
PLAIN: dict[str, str] = {
    "run": "reports/served", "runs": "reports/served", "a": "base/run", "b": "base/run",
    "folders": "reports/served", "tune": "reports/served", "folder": "reports", "dataset": "base/dataset",
    "with_reaction": "base/dataset", "without_reaction": "base/dataset",
    "version": "v2", "file": "evil.txt", "episode": "0", "scenario": "occluded-intersection",
    "names": "evil", "scene": "00000-0", "files": "evil.txt", "rate": "75",
    "prompt compare a": "v2", "prompt compare b": "v4", "init folder": "new",
    "dataset build name": "occluded-intersection",
    "dataset scenario show name": "do-not-pass", "dataset scenario drive name": "do-not-pass",
    "dataset scenario audit "
    "name": "do-not-pass", "radio show name": "6g", "radio check name": "mode4",
    "edition": "small", "commit": "0" * 40, "benchmark seeds names": "narrow-passage",
    "model check name": "proxy", "model pull name": "proxy", "model device show name": "laptop-cpu",
    "model device check "
    "name": "laptop-cpu", "model parity model": "models/evil-weights", "port": "0",
    "serve "
    "model": "mine", "budget": "1", "limit": "1", "episodes": "1", "seeds": "0:1", "workers": "1",
    "layouts": "20",
    "study "
    "attribute "
    "sample": "2", "count": "1", "over": "consensus", "grid": "ego-prompt", "attacks": "jump",
    "rules": "linear", "share": "1/3", "twin": "mirrored", "schedule": "entropy", "samples": "1,1,1,1",
    "prompts": "1", "window_s": "1", "out": "written",
    "run video out": "written/video.gif", "dataset show out": "written/scene.svg",
    "prompt show out": "written.png",
    "eval workers": "", 
        "dataset scenario audit layouts": "2", "prompt check dataset": "base/dataset",
    "study grid model": "proxy,mine", "study trust run": "reports/served", 
        "study paper episodes": "10",
    "sweep_episodes": "10", 
        "study schedule learn out": "written.toml", "run export out": "written/file",
    "report out": "written/page.html",
}  # fmt: skip
# whatever they are given
DEAR = ("prompt examples", "study closed-loop", "study contents", "study paper")
ALWAYS = {"run export": ["--csv"], "study fidelity": ["base/run"], "dataset build": ["--no-audit"]}


def change(file: Path, **values: Any) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def typed(words: str, command: Any, *, every: bool) -> Iterator[list[str]]:
    """What is typed: the command as it is, and with every hostile value of each parameter,
    or with one.
    """
    parameters = [p for p in command.params if p.name not in ("help", "as_json", "quiet")]

    def value(table: Mapping[str, Any], name: str) -> Any:
        return table.get(f"{words} {name}", table.get(name))

    def line(changed: str = "", to: str = "") -> list[str]:
        arguments, options = [], list(ALWAYS.get(words, ()))
        for p in parameters:
            given = to if p.name == changed else value(PLAIN, p.name) or None
            if p.required and given is None:
                pytest.fail(
                    f"harness {words} needs {p.name}: give PLAIN a value, and HOSTILE a hostile one"
                )
            needed = (
                p.required
                or changed == p.name
                or f"{words} {p.name}" in PLAIN
                or p.name not in HOSTILE
            )
            if given is not None and needed:
                at = arguments if p.param_type_name == "argument" else options
                at += [given] if p.param_type_name == "argument" else [p.opts[0], given]
        if changed == "env_config":  # an environment takes the place of a scenario
            place = options.index("--scenario") if "--scenario" in options else len(options)
            arguments, options = [], [*options[:place], *options[place + 2 :], "--env", "merge-v0"]
        return [*words.split(), *arguments, *options]

    if every or not any(value(HOSTILE, p.name) for p in parameters):
        yield line()
    for p in parameters:
        hostile = value(HOSTILE, p.name) or ()
        # By chance, and the same at each time: the commands that read runs meet all kinds of
        # hostile ones.
        first = zlib.crc32(f"{words} {p.name}".encode()) % max(1, len(hostile))
        for each in hostile if every else hostile[first : first + 1]:
            yield line(p.name, each)


@pytest.fixture(scope="module")
def base(small: Dataset, small_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, a frozen run and a driven one, from which the hostile ones are made."""
    folder = tmp_path_factory.mktemp("strangers")
    shutil.copytree(small_path, folder / "base/dataset")
    points = (POINTS["single-local"], POINTS["6g"])
    evaluate(spec_of(small, "proxy", limit=1, points=points), folder / "base/run")
    evaluate(live_spec_of(episodes=1, points=points), folder / "base/driven")
    return folder


@pytest.fixture(scope="module")
def theirs() -> Iterator[Server]:
    """The stranger's server, which nobody may ask: it would answer."""
    with serving(lambda asked: asked.reply(completion("{}")), listed, f"{STRANGE}/v1") as server:
        yield server


def listed(asked: Asked) -> None:
    if not asked.path.startswith(STRANGE):
        # A pool of another worker's test waits for its server, whose port this server was given
        # since.
        asked.reply({}, 404)
        return
    asked.handler.server.asked.append(asked)
    asked.reply({"data": [{"id": "m"}]})


@pytest.fixture(scope="module")
def mine(theirs: Server) -> Iterator[Server]:
    """A server of the user's own, which sends every question to the stranger's."""

    def elsewhere(asked: Asked) -> None:
        asked.reply({"next": theirs.url}, 307, location=f"{theirs.url}/chat/completions")

    with serving(
        elsewhere, lambda asked: asked.reply({"data": [{"id": "m"}], "next": theirs.url})
    ) as server:
        yield server


def cases() -> Iterator[Any]:
    """Every command with all that is hostile to it, and with some of that, unless it is dear."""
    for words, command in commands():
        yield pytest.param(words, command, True, id=words, marks=pytest.mark.exhaustive)
        if words not in DEAR:
            yield pytest.param(
                words, command, False, id=f"{words}, in short", marks=pytest.mark.slow
            )


@pytest.mark.parametrize(("words", "command", "every"), cases())
def test_a_hostile_copy_causes_nothing(
    words: str, command: Any, every: bool, harness: Callable[..., Said], base: Path, theirs: Server,
    mine: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    canary = tmp_path / "canary"
    canary.mkdir()
    (canary / f"{MODULE}.py").write_text(IMPORTED)
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/secret.txt").write_text(
        f"distance_m,reception,{SECRET}\n1,0.9,0\n99,0.1,0\n"
    )
    project = tmp_path / "theirs" / "project"
    project.mkdir(parents=True)
    monkeypatch.chdir(project)
    monkeypatch.syspath_prepend(canary)
    monkeypatch.setenv("CANARY_FILE", str(canary / "imported"))
    monkeypatch.setenv("CANARY_SECRET", SECRET)
    monkeypatch.setenv("OPENAI_API_KEY", f"{SECRET}-of-models")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.delenv("SWARMDRIVE_IMPORTS", raising=False)
    monkeypatch.setattr(uvicorn.Server, "run", visited)
    monkeypatch.setattr(secrets, "token_urlsafe", lambda: "token")
    Strangers(theirs, mine, base)
    theirs.asked.clear()
    for line in typed(words, command, every=every):
        shutil.rmtree("written", ignore_errors=True)
        code, out, err = harness(*line)
        shown = f"harness {' '.join(line)}: {code} {err}"
        assert theirs.asked == [], shown
        assert MODULE not in sys.modules, shown
        assert not (canary / "imported").exists(), shown
        assert SECRET not in out + err, shown
        assert "Traceback" not in err, shown
        if Path("written").is_dir():
            for file in Path("written").rglob("*"):
                assert not file.is_file() or SECRET.encode() not in file.read_bytes(), (shown, file)
    for asked in mine.asked:
        assert asked.headers["Authorization"] == f"Bearer {SECRET}-of-models"


def visited(self: uvicorn.Server, sockets: Any) -> None:
    """The pages of `harness view` as a browser opens them, in place of a server; or a question."""
    browser = TestClient(
        cast("Any", self.config.app),
        base_url="http://127.0.0.1:7654",
        raise_server_exceptions=False,
    )
    if browser.get("/v1/models").status_code == 200:  # of `harness serve`
        asked = {"type": "choice", "criteria": {"{{ environ }}": None, MODULE: None}}
        said = browser.post("/v1/systemone", json={"state": "evil.txt", "questions": {"a": asked}})
        assert said.status_code == 502
        assert SECRET not in said.text
        return
    assert browser.get("/?token=token").status_code == 200
    for name in ("served", "moved", "named", "driven", "traffic"):
        browser.get("/run", params={"path": name})
    for page in ("report", "compare"):
        browser.get(f"/{page}", params={"path": ["driven", "traffic"]})
