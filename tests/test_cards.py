"""Model cards: what a user may write after --model, and what a card file may say."""

import json
import re
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from harness.backends import cards
from harness.backends.answered_prompts import prompt_for
from harness.backends.card import Card, Failures, Latency
from harness.backends.registry import capabilities
from harness.backends.servers import Server
from harness.core import resources
from harness.core.config import convert
from harness.core.errors import UserError
from harness.evaluate.resolve import agents
from harness.runs.settings import Settings
from harness.world import scenarios

SERVED = """\
engine = "openai"
description = "d"
weights = "some-model"
[latency]
source = "paper"
basis = "b"
[server]
base_url = "https://models.example/v1"
"""
FAULTY = """\
engine = "proxy"
description = "d"
[latency]
source = "card"
inference_s = 0
basis = "declared: none"
[failures]
nan = 0.5
"""
ROOT = Path(__file__).parents[1]
TO_COPY = {
    f"models/{file.name}": file.read_text() for file in sorted((ROOT / "docs/cards").glob("*.toml"))
}
MINIMAL = """\
engine = "driver"
description = "d"
[latency]
source = "card"
inference_s = 0
basis = "declared: none"
"""


def write_card(folder: Path, text: str) -> None:
    (folder / "models").mkdir(exist_ok=True)
    (folder / "models" / "mine.toml").write_text(text)


@pytest.fixture
def shelf(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A shelf of cards of our own."""
    monkeypatch.setattr(resources, "folder", lambda kind: tmp_path / kind)
    return tmp_path


@pytest.fixture
def copied(project: Path) -> None:
    """All cards to copy, each in its file of the project that the test is in."""
    for file, card in TO_COPY.items():
        (project / file).write_text(card)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project that the test is in, with no card of its own."""
    monkeypatch.chdir(tmp_path)
    Path("swarmdrive.toml").touch()
    Path("models").mkdir()
    return tmp_path


def test_every_shipped_card_loads_under_its_file_name() -> None:
    assert cards.names() == sorted(file.stem for file in resources.folder("models").glob("*.toml"))
    assert [cards.load(name).name for name in cards.names()] == cards.names()
    assert [cards.load(card.name) for card in cards.load_all()] == cards.load_all()


def test_every_card_to_copy_is_one_of_ones_own_once_it_is_copied(project: Path) -> None:
    for file, card in TO_COPY.items():
        with pytest.raises(UserError, match=f"no longer ships; .* to {re.escape(file)} in your"):
            cards.resolve(Path(file).stem)
        (project / file).write_text(card)
        [first, *others] = cards.each_engine(Path(file).stem)
        assert f"models/{first.name}.toml" == file
        assert [cards.resolve(card.name) for card in (first, *others)] == [first, *others]


def test_a_card_that_no_longer_ships_says_where_it_is_and_runs_again_once_it_is_copied(
    harness: Callable[..., tuple[int, str, str]], project: Path
) -> None:
    file = "models/qwen3-8b.toml"
    said = (
        f"model 'qwen3-8b' no longer ships; copy its card {ROOT}/docs/cards/qwen3-8b.toml to {file} "
        "in your project's folder, which `harness init` makes, and it runs again\n"
    )
    (project / "run.toml").write_text('[helpers]\nmodel = "proxy, qwen3-8b"\n')
    planned = ("--limit", "1", "--dry-run")
    for typed in (
        ("eval", "--model", "qwen3-8b", *planned),
        ("eval", "--model", "proxy", "--helper-model", "proxy,qwen3-8b", *planned),
        ("model", "pull", "qwen3-8b:transformers"),
    ):
        assert harness(*typed) == (2, "", f"harness: {said}")
    assert harness("eval", "run.toml", *planned) == (2, "", f"harness: settings run.toml: {said}")
    (project / file).write_text(TO_COPY[file])
    for again in (("--model", "qwen3-8b"), ("run.toml",)):
        assert harness("eval", *again, *planned)[::2] == (0, "")


@pytest.mark.usefixtures("copied")
def test_language_models_declare_no_latency_that_was_not_measured() -> None:
    for card in cards.load_all():
        if capabilities(card.engine).renders:
            assert card.latency.source in ("paper", "cited"), card.name
            assert (card.latency.source == "cited") == card.latency.basis.startswith("cited: "), (
                card.name
            )
            from_hub = capabilities(card.engine).has_weights and "/" in str(card.weights)
            assert card.licence or not from_hub, card.name


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("name", ["kev-4b", "lev-4b", "laya", "julia-1", "clef", "d1-3b"])
def test_a_published_decision_model_says_whose_it_is_and_that_it_never_ran_here(name: str) -> None:
    card = cards.load(name)
    assert (card.engine, bool(card.licence)) == ("systemone", True)
    assert re.fullmatch(r"[\w-]+/[\w.-]+", card.weights or "")
    if card.latency.source == "cited":
        assert card.latency.basis.endswith("never run here")
        assert re.search(r"\b20\d\d\b", card.latency.basis)


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize(
    ("name", "size_px", "tokens"),
    [
        ("qwen2.5-vl-3b", (448, 224), 128),
        ("qwen3-vl-2b", (512, 256), 128),
        ("qwen3-vl-4b", (512, 256), 128),
        ("smolvlm-256m", (512, 256), 64),
    ],
)
def test_a_model_that_sees_has_its_picture_on_every_engine_and_its_projector_on_one(
    name: str, size_px: tuple[int, int], tokens: int
) -> None:
    for card in (cards.load(name), cards.load(f"{name}:llama-cpp")):
        assert card.vision is not None
        assert (card.vision.size_px, card.vision.tokens) == (size_px, tokens)
        assert card.revision is not None
        assert bool(card.projector) == (card.engine == "llama-cpp") == bool(card.sha256)


SEES = """\
engine = "transformers"
description = "d"
weights = "a/b"
[vision]
width_px = 512
height_px = 256
patch_px = 16
merge = 2
[latency]
source = "paper"
basis = "b"
"""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("= 256", "= 255"), 
            "[vision]: height_px is 255, wants an "
            "even number: two cameras share it"),
        (("= 512", "= 0"), "[vision]: width_px = 0; allowed: 1 or more"),
        (("= 512", "= 5000"), "[vision]: a picture of 5000 x 256 pixels; allowed: 4096 a side"),
        (("merge = 2", ""), "[vision] has no merge; add it"),
        (("merge = 2", "merg = 2"), "unknown key in "),
        (('"transformers"', '"llama-cpp"'), 
            "[vision] and projector go together "
            "on llama-cpp: give the name "
         "of its mmproj file, or leave both out"),
        (("merge = 2", 
            'merge = '
            '2\n[engines.llama-cpp]\nweights = '
            '"a/b"\nfile = "f.gguf"'), "go together on"),
        (("[vision]", 'projector = "p.gguf"\n[vision]'), "projector goes with engine = llama-cpp"),
        (('"transformers"\n', '"proxy"\n'), "goes with engine = "),
    ],
)  # fmt: skip
def test_a_mistake_about_pictures_is_one_line(
    shelf: Path, change: tuple[str, str], said: str
) -> None:
    assert change[0] in SEES
    write_card(shelf, SEES.replace(*change, 1))
    with pytest.raises(UserError) as refused:
        cards.load("mine")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_server_may_be_one_of_a_model_that_sees(shelf: Path) -> None:
    example = (ROOT / "models" / "openai-example.toml").read_text()
    write_card(shelf, re.sub(r"^# (?=\[vision|\w+ = )", "", example, flags=re.M))
    vision = cards.load("mine").vision
    assert vision is not None
    assert vision.tokens == 128


def test_only_full_view_sees_the_truth() -> None:
    assert [name for name in cards.names() if cards.load(name).privileged] == ["full-view"]


def test_the_proxy_cites_the_papers_latency_and_the_language_model_declares_none() -> None:
    assert cards.load("proxy").latency == Latency(
        "card", 0.145, "cited: SwarmDrive paper, single local 145.0 ms"
    )
    qwen = cards.load("qwen3-4b")
    assert (qwen.weights, qwen.dtype, qwen.thinking, qwen.context_tokens, qwen.licence) == (
        "Qwen/Qwen3-4B",
        "bfloat16",
        "switch",
        32768,
        "Apache-2.0",
    )
    assert (qwen.latency.source, qwen.latency.inference_s) == ("paper", None)


def test_a_card_may_have_weights_for_another_engine() -> None:
    qwen, q4 = cards.resolve("qwen3-4b"), cards.resolve("qwen3-4b", "llama-cpp")
    assert (qwen.engine, q4.engine) == ("transformers", "llama-cpp")
    assert (q4.name, q4.weights, q4.file) == (
        "qwen3-4b:llama-cpp", "Qwen/Qwen3-4B-GGUF", "Qwen3-4B-Q4_K_M.gguf",
    )  # fmt: skip
    assert (q4.quantisation, q4.dtype, qwen.file, qwen.sha256) == ("Q4_K_M", "auto", None, None)
    assert (q4.thinking, q4.licence, q4.context_tokens) == (
        qwen.thinking,
        qwen.licence,
        qwen.context_tokens,
    )
    assert (
        cards.resolve("qwen3-4b", "transformers") == cards.resolve("qwen3-4b:transformers") == qwen
    )
    assert (
        cards.resolve("qwen3-4b:llama-cpp")
        == cards.resolve("qwen3-4b:llama-cpp", "llama-cpp")
        == q4
    )


@pytest.mark.parametrize(
    ("text", "engine", "said"),
    [
        ("qwen3-4b", "llama", ["engine 'llama'", "did you mean 'llama-cpp'"]),
        (
            "qwen3-4b",
            "openai",
            ["engine of model qwen3-4b 'openai'", "known: llama-cpp, transformers"],
        ),
        ("qwen3-4b:openai", None, ["engine of model qwen3-4b 'openai'"]),
        ("qwen3-4b:llama-cpp", "transformers", ["'qwen3-4b:llama-cpp' runs on llama-cpp"]),
        ("proxy", "transformers", ["engine of model proxy 'transformers'", "known: proxy"]),
        (
            "someone/model",
            "llama-cpp",
            ["--engine llama-cpp", "'someone/model' runs on transformers"],
        ),
    ],
)
def test_an_engine_that_a_model_has_not_is_one_line(
    text: str, engine: str | None, said: list[str]
) -> None:
    with pytest.raises(UserError) as caught:
        cards.resolve(text, engine)
    for part in said:
        assert part in str(caught.value)


SEEN = '[[prompts]]\nversion = "v10"\nread = 24\nasked = 24\n[[prompts]]\nversion = "v2"\nread = 1\nasked = 24\n'


def test_a_card_names_the_prompts_that_its_model_was_seen_to_answer(shelf: Path) -> None:
    """The scenario's where the card has it, else the card's first."""
    write_card(shelf, TWO_ENGINES + SEEN)
    card = cards.load("mine")
    assert [prompt_for(usual, card.prompts) for usual in ("v2", "v4")] == ["v2", "v10"]
    assert prompt_for("v2", ()) == "v2"
    record = card.record()
    assert record["prompts"][0] == {"version": "v10", "read": 24, "asked": 24}
    assert convert(record, Card, "the record") == card
    write_card(shelf, TWO_ENGINES + SEEN.replace("read = 24", "read = 25"))
    with pytest.raises(UserError, match="read 25 of 24 asked; give as many at most"):
        cards.load("mine")


@pytest.mark.parametrize("version", ["nosuch", "../../../etc/passwd", ""])
def test_an_unknown_prompt_of_a_card_is_one_line_that_names_the_card(
    shelf: Path, version: str
) -> None:
    write_card(shelf, TWO_ENGINES + SEEN.replace("v10", version).replace("v2", "other"))
    with pytest.raises(UserError) as caught:
        agents(Settings(model="mine"), scenarios.get("occluded-intersection"))
    said = str(caught.value)
    assert said.startswith(f"card mine, [[prompts]]: unknown prompt {version!r}")
    assert said.endswith("; correct the card, or give --prompt")
    with pytest.raises(UserError, match=r"^unknown prompt 'nosuch'"):
        agents(Settings(model="mine", prompt="nosuch"), scenarios.get("occluded-intersection"))


TWO_ENGINES = """\
engine = "transformers"
description = "d"
weights = "a/b"
revision = "v1"
[latency]
source = "paper"
basis = "b"
[engines.llama-cpp]
weights = "a/b-GGUF"
file = "b.gguf"
"""


def test_what_was_said_of_one_engines_weights_says_nothing_of_anothers(shelf: Path) -> None:
    write_card(shelf, TWO_ENGINES)
    assert (cards.load("mine").revision, cards.load("mine:llama-cpp").revision) == ("v1", None)
    assert cards.load("mine").latency == cards.load("mine:llama-cpp").latency


def test_an_adapter_changes_the_weights_on_every_engine_that_can_take_one(shelf: Path) -> None:
    write_card(shelf, TWO_ENGINES.replace("[latency]", 'adapter = "taught"\n[latency]'))
    assert (cards.load("mine").adapter, cards.load("mine:llama-cpp").adapter) == (
        "taught",
        "taught",
    )
    write_card(
        shelf,
        TWO_ENGINES.replace("[latency]", 'adapter = "taught"\n[latency]') + 'adapter = "other"\n',
    )
    assert cards.load("mine:llama-cpp").adapter == "other"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("llama-cpp", "proxy"), ["engine in", "'proxy'", "known: decisions, llama-cpp, openai"]),
        (("llama-cpp", "transformers"), ["'transformers'", "known: decisions, llama-cpp"]),
        (
            ('file = "b.gguf"', 'dtype = "float32"'),
            ["[engines.llama-cpp]", "dtype", "transformers"],
        ),
        (('file = "b.gguf"', "licence = 'MIT'"), ["[engines.llama-cpp]", "licence"]),
        (
            ('weights = "a/b-GGUF"', ""),
            ["[engines.llama-cpp]", "weights is missing; engine = llama-cpp needs it"],
        ),
        (
            ('[engines.llama-cpp]\nweights = "a/b-GGUF"', "[engines]\nllama-cpp = 3"),
            ["= '3'", "a table"],
        ),
        (
            ('source = "paper"', 'source = "card"\ninference_s = 0.1'),
            ["[engines.llama-cpp] has no latency; add it"],
        ),
        (('revision = "v1"', 'sha256 = "abc"'), ["sha256 = 'abc'", "64 digits"]),
        (('revision = "v1"', "gated = 1"), ["gated", "true or false"]),
        (
            (
                "[latency]",
                'adapter = "taught"\n[engines.openai]\nweights = "b"\n'
                'server = {base_url = "https://a.example/v1"}\n[latency]',
            ),
            ["[engines.openai]: adapter goes with engine = transformers or llama-cpp"],
        ),
    ],
)
def test_a_mistake_about_engines_is_one_line_that_names_it(
    shelf: Path, change: tuple[str, str], said: list[str]
) -> None:
    refused(shelf, TWO_ENGINES, change, said)


def test_a_gguf_file_is_a_model_named_after_it(tmp_path: Path) -> None:
    file = tmp_path / "small-Q8_0.gguf"
    file.write_bytes(b"GGUF")
    plain = cards.resolve(str(file))
    assert (plain.name, plain.engine, plain.weights) == (
        "small-Q8_0",
        "llama-cpp",
        str(file.resolve()),
    )
    assert (plain.thinking, plain.latency.source, plain.file) == ("none", "paper", None)
    template, key = b"{% if enable_thinking %}", b"tokenizer.chat_template"
    said = (
        struct.pack(f"<4sIQQQ{len(key)}sIQ", b"GGUF", 3, 0, 1, len(key), key, 8, len(template))
        + template
    )
    file.write_bytes(said)
    assert cards.resolve(str(file)).thinking == "switch"


def test_a_directory_with_a_checkpoint_and_a_gguf_file_runs_on_either(tmp_path: Path) -> None:
    folder = tmp_path / "small"
    folder.mkdir()
    (folder / "small-f16.gguf").write_bytes(b"GGUF")
    assert (cards.resolve(str(folder)).engine, cards.resolve(str(folder)).name) == (
        "llama-cpp",
        "small-f16",
    )
    (folder / "config.json").write_text("{}")
    assert cards.resolve(str(folder)).engine == "transformers"
    assert cards.resolve(str(folder), "llama-cpp").weights == str(
        (folder / "small-f16.gguf").resolve()
    )
    (folder / "small-q4.gguf").write_bytes(b"GGUF")
    with pytest.raises(UserError, match=r"holds 2 \.gguf files; give one of them"):
        cards.resolve(str(folder), "llama-cpp")


def test_a_card_of_ones_own_is_one_file(shelf: Path) -> None:
    write_card(shelf, MINIMAL)
    assert cards.names() == ["mine"]
    card = cards.resolve("mine")
    assert (card.name, card.engine, card.weights, card.thinking) == ("mine", "driver", None, "none")
    assert card.latency.inference_s == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("engine =", "motor ="), ["mine.toml", "motor", "engine"]),
        (
            ('basis = "declared: none"', 'basis = "b"\nspeed = 3'),
            ["[latency]", "speed", "inference_s"],
        ),
        (('"driver"', '"drivr"'), ["engine", "drivr", "did you mean 'driver'"]),
        (('source = "card"', 'source = "guess"'), ["source", "guess", "paper"]),
        (('description = "d"', "description = 3"), ["description", "3", "a text"]),
        (('description = "d"', ""), ["description", "add it"]),
        (
            ('description = "d"', 'description = "d"\ncontext_tokens = true'),
            ["context_tokens", "whole number"],
        ),
        (
            ('description = "d"', 'description = "d"\nmax_new_tokens = 0'),
            ["max_new_tokens = 0", "1 or more"],
        ),
        (('description = "d"', 'description = "d"\nweights = "a/b"'), ["weights", "transformers"]),
        (('"driver"', '"transformers"'), ["weights", "transformers"]),
        (('"driver"', '"proxy"\nprivileged = true'), ["privileged", "driver"]),
        (("inference_s = 0", ""), ["inference_s", "card"]),
        (('source = "card"', 'source = "paper"'), ["inference_s", "card"]),
        (("inference_s = 0", "inference_s = -1.0"), ["inference_s = -1.0", "0 or more"]),
        (("inference_s = 0", "inference_s = 1e308"), ["inference_s = 1e+308", "at most 3600"]),
        (("inference_s = 0", "inference_s = nan"), ["inference_s = nan", "0 or more"]),
        (("inference_s = 0", "inference_s = true"), ["inference_s", "a number"]),
        (("[latency]", "[latency"), ["mine.toml", "no TOML"]),
    ],
)
def test_a_mistake_in_a_card_is_one_line_that_names_it(
    shelf: Path, change: tuple[str, str], said: list[str]
) -> None:
    refused(shelf, MINIMAL, change, said)


def refused(shelf: Path, card: str, change: tuple[str, str], said: list[str]) -> str:
    """The one line that a card gets once something in it is changed."""
    broken = card.replace(*change)
    assert broken != card
    write_card(shelf, broken)
    with pytest.raises(UserError) as caught:
        cards.load("mine")
    message = str(caught.value)
    assert "\n" not in message
    for part in ["mine.toml", *said]:
        assert part in message
    return message


def test_a_served_model_has_a_server_with_defaults_that_are_stated(shelf: Path) -> None:
    write_card(shelf, SERVED)
    card = cards.resolve("mine")
    assert (card.engine, card.weights) == ("openai", "some-model")
    assert card.server == Server(
        "https://models.example/v1", "generic", key_env="OPENAI_API_KEY", timeout_s=120.0, retries=3
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("[server]\nbase_url", "[server]\nurl"), ["[server]", "'url'", "base_url"]),
        (('base_url = "https://models.example/v1"', ""), ["[server]", "base_url", "add it"]),
        (("weights =", "revision ="), ["weights", "openai"]),
        (("https:", "ftp:"), ["base_url", "http or https", "give http://models.example/v1"]),
        (("https://models.example", "models.example"), ["base_url", "http or https"]),
        (("https://models.example", "https://:8080"), ["base_url", "host"]),
        (("models.example", "models.example:port"), ["base_url", "no URL"]),
        (("/v1", "/v1#top"), ["base_url", "fragment"]),
        (('"https://models.example/v1"', "[]"), ["[server]", "base_url is an empty list"]),
        (
            ('"https://models.example/v1"', '["http://a/v1", "ftp://b"]'),
            ["base_url", "http or https"],
        ),
        (
            ('"https://models.example/v1"', '["http://a/v1", "http://a/v1/"]'),
            ["base_url", "a server twice"],
        ),
        (("[server]", '[server]\nkind = "vlm"'), ["kind", "vlm", "did you mean 'vllm'"]),
        (("[server]", "[server]\ntimeout_s = 0"), ["timeout_s = 0", "more than 0"]),
        (("[server]", "[server]\ntimeout_s = inf"), ["timeout_s = inf", "more than 0"]),
        (("[server]", "[server]\nretries = -1"), ["retries = -1", "0 to 10"]),
        (("[server]", "[server]\nretries = true"), ["retries", "whole number"]),
        (
            ("[latency]", 'thinking = "switch"\n[latency]'),
            ["thinking", "vllm or llama-server", "at the server"],
        ),
        (('[server]\nbase_url = "https://models.example/v1"', ""), ["[server]", "openai"]),
    ],
)
def test_a_mistake_about_a_server_is_one_line_that_names_it(
    shelf: Path, change: tuple[str, str], said: list[str]
) -> None:
    refused(shelf, SERVED, change, said)


@pytest.mark.parametrize(
    "change",
    [
        ("https://", "https://me:sk-5ecret@"),
        ("https://", "https://sk-5ecret@"),
        ("/v1", "/v1?api-key=sk-5ecret"),
        ("[server]", '[server]\nkey_env = "sk-5ecret"'),
        ("[server]", '[server]\napi_key = "sk-5ecret"'),
    ],
)
def test_a_secret_in_a_card_is_refused_and_not_repeated(
    shelf: Path, change: tuple[str, str]
) -> None:
    assert "5ecret" not in refused(shelf, SERVED, change, ["[server]"])


def test_a_server_and_failures_go_with_their_engines_only(shelf: Path) -> None:
    served = ("[latency]", '[server]\nbase_url = "http://a/v1"\n[latency]')
    refused(shelf, MINIMAL, served, ["[server]", "openai"])
    refused(
        shelf, MINIMAL, ("[latency]", "[failures]\nnan = 0.5\n[latency]"), ["[failures]", "proxy"]
    )


def test_a_faulty_proxy_is_declared_by_its_shares(shelf: Path) -> None:
    write_card(shelf, FAULTY)
    assert cards.resolve("mine").failures == Failures(nan=0.5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("nan = 0.5", "naan = 0.5"), ["'naan'", "did you mean 'nan'"]),
        (("nan = 0.5", "nan = 1.5"), ["nan = 1.5", "0 to 1"]),
        (("nan = 0.5", "nan = -0.5"), ["nan = -0.5", "0 to 1"]),
        (("nan = 0.5", "nan = nan"), ["nan = nan", "0 to 1"]),
        (("nan = 0.5", "nan = 0.5\nprose = 0.6"), ["sum to 1.1", "1 at most"]),
        (("nan = 0.5", "slow_tail = 0.5"), ["slow_tail", "slow_s", "together"]),
        (("nan = 0.5", "slow_s = 0.5"), ["slow_tail", "slow_s", "together"]),
        (("nan = 0.5", "slow_s = inf"), ["slow_s = inf", "seconds"]),
        (
            ('source = "card"\ninference_s = 0', 'source = "paper"'),
            ["slow tail", 'source = "card"'],
        ),
    ],
)
def test_a_mistake_about_failures_is_one_line_that_names_it(
    shelf: Path, change: tuple[str, str], said: list[str]
) -> None:
    card = (
        FAULTY.replace("nan = 0.5", "slow_tail = 0.5\nslow_s = 1")
        if "source" in change[0]
        else FAULTY
    )
    refused(shelf, card, change, ["[failures]", *said])


def test_a_directory_with_a_config_is_a_transformers_model_named_after_it(tmp_path: Path) -> None:
    checkpoint = tmp_path / "my-model"
    checkpoint.mkdir()
    (checkpoint / "config.json").write_text("{}")
    card = cards.resolve(str(checkpoint))
    assert (card.name, card.engine, card.weights) == (
        "my-model",
        "transformers",
        str(checkpoint.resolve()),
    )
    assert (card.latency.source, card.thinking, card.dtype) == ("paper", "none", "auto")


def test_a_directorys_thinking_switch_is_read_from_its_chat_template(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "tokenizer_config.json").write_text(
        json.dumps({"chat_template": "{{ enable_thinking }}"})
    )
    assert cards.resolve(str(tmp_path)).thinking == "switch"


def test_a_text_with_a_slash_that_is_no_directory_is_a_hub_id() -> None:
    card = cards.resolve("someone/some-model-1.5B")
    assert (card.name, card.engine, card.weights) == (
        "someone/some-model-1.5B",
        "transformers",
        "someone/some-model-1.5B",
    )


def test_a_run_is_replayed_by_its_directory(tmp_path: Path) -> None:
    run = tmp_path / "run-7"
    run.mkdir()
    card = cards.resolve(f"replay:{run}")
    assert (card.name, card.engine, card.weights) == ("replay:run-7", "replay", str(run.resolve()))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("qwen3-4", ["'qwen3-4'", "did you mean 'qwen3-4b'", "known: brake, ", "replay:RUN_DIR"]),
        ("./no/such/dir", ["'./no/such/dir'", "no directory", ".gguf", "hub id"]),
        ("./no/such.gguf", ["'./no/such.gguf'", "no .gguf file"]),
        ("replay:nowhere", ["'replay:nowhere'", "no such run directory"]),
        # and no hub id, though it could be one
        ("no/such.gguf", ["'no/such.gguf'", "no .gguf file"]),
        ("replay:", ["'replay:'", "no such run directory"]),
        ("../models/proxy", ["'../models/proxy'", "no directory"]),
    ],
)
def test_a_model_that_is_nothing_says_what_would_be_one(text: str, said: list[str]) -> None:
    with pytest.raises(UserError) as caught:
        cards.resolve(text)
    for part in said:
        assert part in str(caught.value)


def test_a_directory_without_a_config_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"holds no config\.json and no \.gguf file; give the directory of"
    ):
        cards.resolve(str(tmp_path))


@given(st.text(max_size=60).filter(lambda text: text not in cards.names()))
@example("~nobody-of-that-name/x")
@example("x" * 5000)
@example("a/" + "b" * 5000)
@example("\0/\x1b[31m")
@example("replay:\0")
def test_whatever_is_typed_is_a_hub_id_or_one_printable_line(text: str) -> None:
    try:
        card = cards.resolve(text)
    except UserError as error:
        message = str(error)
        assert message.isprintable(), message
    else:
        assert (card.name, card.engine) == (text, "transformers")


def test_a_card_saved_with_a_byte_order_mark_is_the_same_card(shelf: Path) -> None:
    write_card(shelf, MINIMAL)
    plain = cards.load("mine")
    write_card(shelf, "\ufeff" + MINIMAL)
    assert (shelf / "models/mine.toml").read_bytes().startswith(b"\xef\xbb\xbf")
    assert cards.load("mine") == plain


@pytest.mark.parametrize("config", ["[" * 100_000, "5", "[]"], ids=lambda text: text[:3])
def test_a_checkpoint_whose_config_is_no_table_is_one_line(config: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(config)
    with pytest.raises(UserError, match="its config does not say how it takes pictures"):
        cards.resolve(str(tmp_path))
