"""A model by its URL: the server is asked what it has and what it is,
and is believed no further.
"""

import json
import re
import shlex
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from misbehaving import Asked, Play, completion, serving
from served import answer, llama_cpp_server
from test_server_identity import SERVERS, answering
from tiers import some

from harness.backends import cards
from harness.backends.openai import http
from harness.backends.servers import Kind, Server
from harness.core import resources
from harness.core.errors import Unanswered, UserError
from harness.evaluate.asking import WITH_EXAMPLES, _say_unread
from harness.prompts import versions as prompts
from harness.world import scenarios

KEY = "sk-of-mine-5ecret"
OTHERS = {
    "llama-cpp-python": {"/openapi.json": {"info": {"title": 
        "🦙 llama.cpp Python API", "version": "0.3"}}},
}  # fmt: skip
NEEDED = ("llama_cpp", "fastapi", "starlette_context", "sse_starlette", "pydantic_settings")


@pytest.fixture(autouse=True)
def local(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.delenv("OPENAI_BASE_URL", raising=False)
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def never(asked: Asked) -> None:
    raise AssertionError(f"asked for {asked.path}")


def listing(*ids: Any) -> Play:
    return answering({"/v1/models": {"data": [{"id": each} for each in ids]}})


@pytest.mark.parametrize("kind", SERVERS)
def test_each_kind_of_server_is_told_by_what_it_alone_answers(kind: Kind) -> None:
    paths = SERVERS[kind] | OTHERS.get(kind, {})
    with serving(never, answering(paths)) as there:
        card = cards.resolve(f"{there.url}#m" if kind == "ollama" else there.url)
        assert card.server.kind == kind
        assert card.server.base_url == there.url
    # A file's name is what people read, and the server is asked by what it lists.
    name, listed = ("tiny", "/srv/models/tiny.gguf") if kind == "llama-server" else ("m", "m")
    listed = "m:latest" if kind == "ollama" else listed
    assert (card.name, card.weights) == (f"served:{listed if kind == 'ollama' else name}", listed)
    assert (card.engine, card.thinking, card.system) == ("openai", "none", None)


@pytest.mark.parametrize(
    ("kind", "path", "says", "thinking"),
    [
        (
            "llama-server",
            "/props",
            {"chat_template": "{% if enable_thinking %}{% endif %}"},
            "switch",
        ),
        ("ollama", "/api/show", {"capabilities": ["completion", "thinking"]}, "always"),
        ("ollama", "/api/show", {"capabilities": ["completion"]}, "none"),
    ],
)
def test_a_model_thinks_as_its_server_says(kind: Kind, path: str, says: Any, thinking: str) -> None:
    paths = SERVERS[kind] | {path: SERVERS[kind][path] | says}
    with serving(never, answering(paths)) as there:
        assert (
            cards.resolve(f"{there.url}#m" if kind == "ollama" else there.url).thinking == thinking
        )


@pytest.mark.parametrize(("heeds", "thinking"), [(True, "switch"), (False, "none")])
def test_vllm_tells_by_its_count_of_tokens_whether_thinking_can_be_turned_off(
    heeds: bool, thinking: str
) -> None:
    def listed(asked: Asked) -> None:
        if asked.path == "/tokenize":
            on = asked.body["chat_template_kwargs"]["enable_thinking"]
            asked.reply({"count": 9 if on or not heeds else 13})
        else:
            answering(SERVERS["vllm"])(asked)

    with serving(never, listed) as there:
        assert cards.resolve(there.url).thinking == thinking


def test_a_decision_model_is_asked_for_decisions() -> None:
    listed = {"data": [{"id": "d", "architecture": {"output_modalities": ["text", "decisions"]}}]}
    with serving(never, answering({"/v1/models": listed})) as there:
        assert cards.resolve(there.url).engine == "systemone"


def test_one_of_several_is_named_behind_the_url(monkeypatch: pytest.MonkeyPatch) -> None:
    with serving(never, listing("b", "a:latest", 7, "", "x" * 900, "evil\x1b[2J")) as there:
        with pytest.raises(
            UserError, match=f"serves 2 models: a:latest, b; give one, as --model '{there.url}#a"
        ):
            cards.resolve(there.url)
        with pytest.raises(UserError, match="has no model 'c': a:latest, b; give one"):
            cards.resolve(f"{there.url}#c")
        one = cards.resolve(f"{there.url}#a")
        assert one.weights == "a:latest"
        assert cards.resolve(cards.argument(one)) == one
        monkeypatch.setenv("OPENAI_BASE_URL", f"{there.url}/")
        assert cards.resolve("openai:a") == one
        bare = there.url.removesuffix("/v1")
        assert cards.resolve(f"{bare}#b") == cards.resolve(f"{there.url}#b")


def test_a_server_without_a_list_needs_the_models_name() -> None:
    with serving(never, answering({})) as there:
        with pytest.raises(
            UserError, match=r"/models lists no model \(HTTP 404: no such path\); give the base"
        ):
            cards.resolve(there.url)
        assert cards.resolve(f"{there.url}#m").weights == "m"


def refusing(status: int) -> Play:
    return lambda asked: asked.reply({"error": f"no, {KEY} is wrong"}, status)


def endless(asked: Asked) -> None:
    asked.raw(b"HTTP/1.1 200 OK\r\n\r\n")
    while True:
        asked.raw(b" ")
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("play", "error", "words"),
    [
        (refusing(401), Unanswered, 
            r"refuses the key \(HTTP 401: no, "
            r"\[key\] is wrong\); set OPENAI"),
        (refusing(503), Unanswered, r"no server answers at .*HTTP 503"),
        (endless, Unanswered, r"no server answers at .* \(no whole answer within 0.3 s\)"),
        (lambda asked: asked.reply(b" " * (http.MOST_BYTES + 1)), UserError, "longer than"),
        (lambda asked: asked.reply(b'{"data": ' + b"[" * 10**5), UserError, 
            "the answer is no JSON"),
        (lambda asked: asked.reply({"data": {"id": "m"}}), UserError, "lists no model"),
    ],
)  # fmt: skip
def test_a_bad_server_is_one_line(
    play: Play, error: type[Exception], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "CONNECT_S", 0.3 if play is endless else 10)
    with serving(never, play) as there, pytest.raises(error, match=words) as raised:
        cards.resolve(there.url)
    assert "\n" not in str(raised.value)
    assert KEY not in str(raised.value)


@pytest.mark.parametrize(
    "url",
    ["http://me:hunter22@127.0.0.1/v1", "http://", "http://127.0.0.1:0/v1", "https://h/v1?key=hunter22", "http://[/v1"],
)  # fmt: skip
def test_what_is_no_base_url_is_not_asked_and_not_shown(url: str) -> None:
    with pytest.raises(UserError, match=r"--model: base_url .*; give one such as http") as raised:
        cards.resolve(url)
    assert "hunter22" not in str(raised.value)


ADDRESSES = {
    "127.0.0.1:9101": "http://127.0.0.1:9101/v1",
    "localhost:8080/v1": "http://localhost:8080/v1",
    "gpu-1.lab.example:8000/v1/": "http://gpu-1.lab.example:8000/v1",
    "[::1]:8080": "http://[::1]:8080/v1",
    "htp://127.0.0.1:9101/v1": "http://127.0.0.1:9101/v1",
    "https:/127.0.0.1:9101": "https://127.0.0.1:9101/v1",
    "HTTPS//10.0.0.1:9101": "https://10.0.0.1:9101/v1",
}


@pytest.mark.parametrize(("typed", "meant"), ADDRESSES.items())
def test_an_address_without_a_scheme_is_told_the_url_that_it_means(typed: str, meant: str) -> None:
    with pytest.raises(UserError, match=re.escape(f"give {meant}") + "$"):
        cards.resolve(typed)
    with pytest.raises(ValueError, match=rf"^base_url .*; give {re.escape(meant)}$"):
        Server(typed)


@pytest.mark.parametrize(
    "typed",
    ["me:hunter22@127.0.0.1:80/v1", "127.0.0.1:80/v1?key=hunter22", "127.0.0.1:80/v1#hunter22"],
)
def test_an_address_with_a_secret_is_not_shown_with_a_scheme(typed: str) -> None:
    with pytest.raises(ValueError, match="give one such as http") as raised:
        Server(typed)
    assert "hunter22" not in str(raised.value)
    with pytest.raises(UserError) as refused:
        cards.resolve(typed)
    assert "hunter22" not in str(refused.value).partition("give ")[2]
    assert ("give http://" in str(refused.value)) == ("#" in typed)  # of a name's place alone


def test_a_model_behind_an_address_without_a_scheme_is_told_how_to_be_named() -> None:
    for typed in ("gpu-1:8000#qwen", "gpu-1:8000/v1#qwen"):
        with pytest.raises(UserError, match=r"give http://gpu-1:8000/v1#NAME$"):
            cards.resolve(typed)


def test_a_name_that_is_no_address_is_told_the_models(
    harness: Callable[..., tuple[int, str, str]],
) -> None:
    assert "did you mean 'qwen3-4b'?" in harness("eval", "--model", "qwen3:4b")[2]
    assert "no hub id; give an existing path" in harness("eval", "--model", "not/there/at:all")[2]


@pytest.mark.slow
def test_a_run_by_url_states_its_card_and_can_be_typed_again(
    small_path: Path, harness: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    what = [
        "--dataset",
        small_path,
        "--limit",
        "1",
        "--condition",
        "single-local",
        "--seeds",
        "0:1",
    ]
    quiet = ("--no-cache", "--quiet")
    with serving(answer, listing("lab/tiny:q4")) as there:
        code, _, said = harness("eval", "--model", there.url, *what, *quiet, "--out", "one")
        assert code == 0, said
        record = json.loads(Path("one/run.json").read_text())
        assert record["model"]["server"]["base_url"] == there.url
        assert (record["model"]["name"], record["model"]["weights"]) == (
            "served:lab/tiny:q4",
            "lab/tiny:q4",
        )
        assert all(asked.headers["Authorization"] == f"Bearer {KEY}" for asked in there.asked)
        typed = shlex.split(record["command"])
        assert typed[typed.index("--model") + 1] == f"{there.url}#lab/tiny:q4"
        code, _, said = harness(*typed[1:-1], "two", *quiet)
        assert code == 0, said
    one, two = (
        [json.loads(line)["raw"] for line in Path(run, "answers.jsonl").read_text().splitlines()]
        for run in ("one", "two")
    )
    assert one == two
    assert len(one) > 1
    files = [path for path in Path("one").rglob("*") if path.is_file()]
    assert not any(KEY.encode() in path.read_bytes() for path in files)


WEIGHTS = resources.folder("models") / "swarm-tiny/swarm-tiny-f16.gguf"
CARD = """
engine = "openai"
description = "a server's"
weights = "lab/tiny:q4"
server.base_url = "http://127.0.0.1:9/v1"
latency = {source = "paper", basis = "none declared"}
"""


@pytest.mark.parametrize("brought", some(["a URL"], exhaustive=["a file of weights", "a server"]))
def test_a_run_of_what_the_user_brought_runs_again_as_the_first_line_of_its_file_says(
    brought: str, small_path: Path, harness: Callable[..., tuple[int, str, str]]
) -> None:
    if brought == "a file of weights":
        pytest.importorskip("llama_cpp", reason="needs the llama-cpp extra")
    Path("models").mkdir()
    Path("models/mine.toml").write_text(CARD)
    Path("swarmdrive.toml").touch()
    what = [
        "--dataset",
        small_path,
        "--limit",
        "1",
        "--condition",
        "single-local",
        "--seeds",
        "0:1",
    ]
    quiet = ("--no-cache", "--quiet")
    with serving(answer, listing("lab/tiny:q4")) as there:
        words = {
            "a URL": ("--model", there.url), "a file of weights": ("--model", str(WEIGHTS)),
            "a server": ("--model", "mine", "--server", there.url),
        }[brought]  # fmt: skip
        code, _, said = harness("eval", *words, *what, *quiet, "--out", "one")
        assert code == 0, said
        first = Path("one/run.toml").read_text().partition("\n")[0]
        asked = len(there.asked)
        code, _, refused = harness("eval", "one/run.toml", *quiet, "--out", "two")
        assert (code, refused.count("\n"), len(there.asked)) == (2, 1, asked), (
            "a file alone asks nobody"
        )
        _, command, _ = first.split("`")
        assert command.startswith("harness eval run.toml --")
        assert f"`{command.replace('run.toml', 'one/run.toml')}`" in refused
        _, *typed = shlex.split(command.replace("run.toml", "one/run.toml"))
        code, _, said = harness(*typed, *quiet, "--out", "two")
        assert code == 0, said
    for name in ("decisions.parquet", "episodes.csv", "summary.csv", "run.toml"):
        assert Path("two", name).read_bytes() == Path("one", name).read_bytes()


def chatting(asked: Asked) -> None:
    asked.reply(completion("I would rather wait and see."))


def wavering(asked: Asked) -> None:
    (answer if asked.number % 5 == 0 else chatting)(asked)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("play", "prompt", "tries"),
    [(chatting, "v2", "v10"), (chatting, "v10", "VERSION"), (wavering, "v2", None)],
)
def test_a_model_whose_first_answers_cannot_be_read_is_told_at_once_and_goes_on(
    play: Play,
    prompt: str,
    tries: str | None,
    small_path: Path,
    harness: Callable[..., tuple[int, str, str]],
) -> None:
    what = [
        "--dataset",
        small_path,
        "--condition",
        "single-local",
        "--seeds",
        "0:1",
        "--prompt",
        prompt,
    ]
    with serving(play, listing("lab/tiny:q4")) as there:
        typed = ("--model", there.url, *what, "--no-cache", "--quiet", "--out", "run")
        code, _, said = harness("eval", *typed)
    assert (code, Path("run/report.html").is_file()) == (0, True)
    command = f"harness prompt check {tries} --model '{there.url}#lab/tiny:q4'"
    assert said == (
        f"harness: none of the first answers of served:lab/tiny:q4 to prompt {prompt} could be "
        f"read; try another: `{command}`; `harness prompt list` shows all\n"
        if tries else ""
    )  # fmt: skip
    _say_unread.cache_clear()
    code, _, said = harness("run", "check", "run")
    assert (code, said) == (0, "")  # its model is asked nothing


def test_the_prompt_that_is_to_be_tried_is_there_for_every_scenario() -> None:
    prompt = prompts.load(WITH_EXAMPLES)
    assert prompt.released
    assert all(
        prompts.unfit(prompt, scenario) is None
        for scenario in map(scenarios.get, scenarios.names())
    )


@pytest.mark.slow
@pytest.mark.skipif(
    any(find_spec(name) is None for name in NEEDED), reason=f"needs {', '.join(NEEDED)}"
)
def test_a_real_server_is_known_and_evaluated_by_its_url(
    small_path: Path, harness: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    """llama-cpp-python's, with the model that ships; its list has the file's path."""
    gguf = resources.find("models", "swarm-tiny") / "swarm-tiny-f16.gguf"
    with llama_cpp_server(gguf, tmp_path / "server.log", api_key=KEY, n_ctx="1024") as url:
        card = cards.resolve(url)
        assert (card.name, card.server.kind) == ("served:swarm-tiny-f16", "llama-cpp-python")
        code, out, said = harness(
            "eval", "--model", url, "--dataset", small_path, "--limit", "1", "--condition", "single-local",
            "--seeds", "0:1", "--no-cache", "--out", "run",
        )  # fmt: skip
    assert code == 0, said
    assert "served:swarm-tiny-f16" in out
    answers = [json.loads(line) for line in Path("run/answers.jsonl").read_text().splitlines()]
    assert {each["status"] for each in answers} == {"strict"}
