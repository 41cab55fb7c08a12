"""Every command and every piece of Python in the documents is run, and prints what its page shows.

A page is a story, from top to bottom in one folder. A command that is neither run nor excused by
name fails its page, and so does a line that is shown and was not printed. Most pages are followed
by `make exhaustive` alone: what they type, the tests of those commands prove, and each line of them
is held against the program.
"""

import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from difflib import unified_diff
from pathlib import Path
from typing import Any

import pytest
from reference import (
    CARDS_PAGE,
    FIELDS_PAGE,
    GROUPS,
    NAMES_PAGE,
    PAGE,
    SETTINGS_PAGE,
    all_typed,
    blocks,
    cards,
    commands,
    fields,
    names,
    pages,
    reference,
    settings,
    typed,
)
from tiers import some
from typer import TyperException
from typer.main import get_command

from harness.cli import app
from harness.core.errors import UserError
from harness.core.shards import shard_of
from harness.evaluate.latency import NAMES, declared
from harness.runs.settings import parse_seeds

pytest.importorskip("harness.extensions")  # whose commands the documents show, too

Harness = Callable[..., tuple[int, str, str]]
Copied = Callable[[str], str]

ROOT = Path(__file__).parent.parent
COMMANDS = dict(commands(get_command(app), "harness"))


def command_of(line: str) -> str:
    """What a line types, without its comment and in one way of quoting."""
    return shlex.join(shlex.split(line, comments=True))


TYPED = list(dict.fromkeys(map(command_of, all_typed())))

# Tables with the commands that made them, which take hours.
MEASURED = sorted((ROOT / "benchmarks/measured").rglob("*.md"))

# What a reader is taken to have: the model that ships stands for his own.
READER_HAS = {
    "my-checkpoint": ROOT / "models/swarm-tiny",
    "tokenizer.json": ROOT / "models/swarm-tiny/tokenizer.json",
    "street": ROOT / "tests/extensions/roads/street",
    "my-crossing.xml": ROOT / "tests/extensions/roads/crossing.xml",
    **{
        f"crossing.{part}.xml": ROOT / f"benchmarks/traffic/crossing.{part}.xml"
        for part in ("net", "rou", "poly")
    },
}

CHECKED = (
    "harness prompt check mine --tokenizer ../tokenizer.json --dataset occluded-intersection-v2"
)

# Added to what is typed, where it would take minutes; of an option given twice the last one counts.
# A whole line has its own, or its command's. Lines that show what they print are not cut; what they
# read may not be.
SHARD = "--episodes 4 --seeds 0 --workers 1"
CUT = {
    # then compared
    **{line: "" for line in TYPED if re.search("--limit 20 --out reports/[ab]$", line)},
    "harness drive --model proxy --shard 1/2 --out reports/split/1": SHARD,
    "harness drive --model proxy --shard 2/2 --out reports/split/2": SHARD,
    "harness eval --model ./my-checkpoint": "--limit 1",  # by transformers, which is slow on a CPU
    "harness eval --model my-model": "--limit 1",
    # of each of six families
    **{line: "--limit 1" for line in TYPED if "--dataset suite:" in line},
    **{
        line: "--limit 1"
        for line in TYPED
        if re.match(r"harness eval --model swarm-tiny (?!.*--(prompt|no-cache))", line)
    },
    "harness eval": "--limit 2",  # of 240 episodes; one has no interval to gate on
    "harness study grid": "--limit 1 --seeds 0:1",  # of 200 episodes
    "harness drive": "--episodes 1 --seeds 0 --workers 1",  # of 240 with 5 seeds
    "harness study promise": "--delta 99",  # one layout is enough
    "harness study contents": "--condition 6g --seeds 0",  # of 21 points and 5 seeds
    "harness study schedule compare": "--schedule entropy",  # of all
    "harness study twins": "--sample 1 --workers 1",  # of 12 episodes
    "harness study attribute": "--sample 2",  # of 40 decision points
    # of 15, 10, 2 and 5
    "harness study trust": "--attacks liar+spoof --rules trust --share 1/3 --seeds 0:1",
    "harness study paper": "--episodes 10 --sweep-episodes 10",  # of 1500 and 300 a grid point
    # of 300 layouts with 5 seeds
    "harness study closed-loop": "--episodes 1 --seeds 0 --workers 1",
    "harness dataset build": "--episodes 2 --workers 1",  # of 40 and of 1000
    **{
        line: "--episodes 1 --workers 1"
        for line in TYPED
        if line.startswith("harness dataset build --env")
    },
    "harness dataset scenario drive": "--episodes 2 --workers 1",  # of 100 and of 500
    "harness dataset scenario audit": "--layouts 24 --workers 1",  # of 300
    # 24: a tell
    "harness dataset scenario audit occluded-intersection": "--layouts 40 --workers 1",
    "harness model distill": "--layouts 2 --samples 16,16,16,16 --workers 1",  # of 240 and 300 000
    CHECKED: "--dataset ../few",  # 4 episodes of 240
    "harness prompt optimize": "--tune ../few --limit 2",  # 4 layouts of 24, and 2 of 240
    "harness model parity": "--prompts 1",  # of 64, on two engines
}

# Ends otherwise than its page shows, since what it reads was cut.
CUT_ENDS = {
    # Each of two episodes is the only one of its kind.
    "harness plan reports/v2 reports/v4 --detect 5": 2,
    # The model that ships has 768 tokens; the page counts those of a Qwen.
    CHECKED: 1,
}

# Held against the program's options, and not run.
NOT_RUN = {
    "harness model device measure --model swarm-tiny": "needs a meter of energy",
    "harness view": "serves until it is interrupted; tests/extensions/view starts it",
    "harness serve --model swarm-tiny": "as above; "
    "tests/extensions/decide/test_serving.py "
    "starts it",
    "harness eval --model systemone-example --server http://127.0.0.1:8080/v1 --answer decision --prompt v9 --batch-size 1": "needs that server; tests/extensions/decide/test_serving.py has one",
    **{
        line: "needs that server; tests/test_by_url.py has such ones"
        for line in TYPED
        if re.match(r"harness eval --model '?http://", line)
    },
    "harness benchmark run v2v-safety-1.1 --model proxy --made-by 'Ada, of Example' --out "
    "reports/proxy": (
        "takes 20 CPU seconds; tests/extensions/benchmark/test_editions.py runs a small edition"
    ),
    "harness benchmark verify reports/proxy.zip": "as above",
    "harness benchmark board 'reports/*.zip' --out board.html": "as above",
    "harness benchmark pack reports/proxy --made-by 'Ada, of Example' --out ada.zip": "as above",
    "harness eval --model proxy "
    "--limit 40 --tracker mlflow": "needs mlflow; tests of trackers have it",
    "harness model pull qwen3-4b": "fetches weights from a hub",
    "harness model pull smollm2-135m": "fetches weights from a registry; "
    "tests/test_packages.py does",
    "harness model check smollm2-135m": "needs those weights",
    "harness prompt check v10 --model smollm2-135m": "needs those weights",
    "harness eval --model smollm2-135m --limit 4": "needs those weights",
    "harness model distill occluded-intersection --base "
    "smollm2-135m --lora --rate 5e-4 --dtype bfloat16 "
    "--prompt v9 --samples 0,12800,0,0 --out models/mine": "needs those weights, and an hour",
    "harness eval --model smollm2-135m --prompt v9 --answer readout "
    "--condition single-local --condition 6g --control shuffled-messages "
    "--limit 100 --out reports/before": "needs those weights",
    "harness eval --model models/mine --prompt v9 --answer readout --condition "
    "single-local --condition 6g --control shuffled-messages --limit 100 --out "
    "reports/after": "as above",
    "harness compare reports/before reports/after": "needs those runs",
    "harness model check qwen3-4b": "needs those weights",
    "harness eval --model qwen3-4b": "needs those weights",
    "harness eval --model my-served --server http://gpu-1:8000/v1 --server http://gpu-2:8000/v1"
    " --batch-size 256": "needs servers; tests/test_servers.py has some",
    "harness eval --model qwen3-4b --engine llama-cpp": "needs weights from a hub",
    "harness eval --model swarm-tiny --latency measured": "a busy machine is refused",
    "harness run export reports/proxy-v2-occluded-intersection-v3 --inspect "
    "logs/run.eval": "needs inspect",
    "harness study reaction datasets/lanes datasets/lanes-replayed": "needs a recording; tests of "
    "every study have one",
}
OTHER_PROGRAMS = {
    "inspect": "serves until it is interrupted",
    "make": "CI runs it",
    "source": "the tests are in an environment already",
    "pip": "as above",
    "ray": "starts a cluster; tests/test_ray.py has one of its own",
    "uv": "fetches packages; tests/test_wheel.py installs the same wheel",
    "uvx": "as above",
    "podman": "fetches an image of Python",
    "pre-commit": "tests/test_hooks.py reads what it would run",
}

# Pages that show anything have these whole: they are run once, after what they need, and copied
# into their folders.
PROXY, LOCAL_VIEW = "harness eval --model proxy", "harness eval --model local-view"
EVALUATED, OTHER = (
    f"reports/{model}-v2-occluded-intersection-v3" for model in ("proxy", "local-view")
)
ONCE = {
    PROXY: (),
    LOCAL_VIEW: (),
    f"harness compare {OTHER} {EVALUATED}": (LOCAL_VIEW, PROXY),
    f"harness study sweep {EVALUATED} --over loss --grid 0,0.2,0.4": (PROXY,),
}

# Pages that `make test` follows, each with how the lines begin that it leaves out.
FOLLOWED = {
    "docs/answers.md": ("harness init", "cd ", "harness dataset", "harness eval", "harness model",
        "harness study", "import harness"),
    "docs/comparing.md": ("harness eval", "harness compare", "harness run history", 
        "harness plan reports/"),
    "docs/radio.md": ("harness eval", "harness radio check"),
}  # fmt: skip


def shell_of(page: Path) -> list[tuple[str, str]]:
    """The lines that a page has a reader type, each with what it shows below."""
    return [
        each for language, block in blocks(page) if language == "console" for each in typed(block)
    ]


def lines_of(page: Path) -> list[str]:
    """What a page has a reader type."""
    return [command_of(line) for line, _ in shell_of(page)]


# Values that a command reads when it runs; a name of a run, model or prompt may be the reader's
# own.
READ: dict[str, Callable[[str], object]] = {
    "latency": lambda text: text in (*NAMES, "run") or declared(text),
    "seeds": parse_seeds,
    "shard": shard_of,
}


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


SHOWN = {  # by page; but the code that `echo $?` shows, which the line before it has to end with
    name(page): {
        command_of(line) for line, shown in shell_of(page) if shown.strip() and line != "echo $?"
    }
    for page in pages()
}


def parsed(args: list[str]) -> tuple[str, list[str]]:
    """The command that is meant, and what stands behind it. Fails if there is no such command."""
    for words in (3, 2, 1):
        path = " ".join(["harness", *args[:words]])
        if path in COMMANDS:
            return path, args[words:]
    return pytest.fail(f"no such command: harness {shlex.join(args)}")


def hold_against_options(args: list[str]) -> None:
    """Fail if the program has no such command or options, or refuses a value for its form."""
    path, rest = parsed(args)
    given = COMMANDS[path].make_context(path, rest).params
    for option, read in READ.items():
        if given.get(option) is not None:
            read(given[option])


def is_whole(words: list[str]) -> bool:
    """Whether the words behind a command in a sentence make it one that can be typed.

    A bare name, one that ends with an option and one with a placeholder,
    a word in capitals or with an ellipsis, are not.
    """
    placeholder = any(
        re.fullmatch(r"[A-Z]+", word) or re.search(r"\.\.\.|…", word) for word in words
    )
    return bool(words) and not words[-1].startswith("--") and not placeholder


def expression(shown: list[str]) -> str:
    """What a page shows, as a regular expression:
    `…` alone is any lines, and in a line any text.
    """
    return "".join(
        r"(?:.*\n)*?" if line == "…" else re.escape(line).replace("…", ".*") + r"\n"
        for line in shown
    )


def difference(shown: str, printed: str) -> str:
    """What a page shows against what was printed, if they differ;
    white space at line ends does not count.
    """
    showing, printing = (
        [line.rstrip() for line in text.rstrip().split("\n")] for text in (shown, printed)
    )
    if re.fullmatch(expression(showing), "".join(f"{line}\n" for line in printing)):
        return ""
    return "\n".join(unified_diff(showing, printing, "shown", "printed", lineterm=""))


@pytest.fixture
def reader(harness: Harness, monkeypatch: pytest.MonkeyPatch, svg_alone: None) -> Harness:
    """The command as a reader types it, who sees stdout and stderr in one place."""
    # so that four episodes are two shards
    monkeypatch.setattr("harness.evaluate.run.EPISODES_AT_ONCE", 1)
    from harness.extensions.media.stills import stills

    monkeypatch.setattr(
        "harness.extensions.media.video.stills", lambda played: [*stills(played)][::20]
    )
    # a reader's terminal has a bar instead
    monkeypatch.setattr("harness.cli.progress.LINE_S", 3600.0)
    monkeypatch.setattr(sys, "stderr", sys.stdout)
    return harness


@pytest.fixture
def copied(reader: Harness, once: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> Copied:
    """Types a command of `ONCE`: what it writes is copied to this folder,
    and what it prints is returned.
    """

    def made(command: str) -> Path:
        def fill(folder: Path) -> None:
            folder.mkdir()
            for need in ONCE[command]:
                shutil.copytree(made(need), folder, dirs_exist_ok=True)
            with monkeypatch.context() as inside:
                inside.chdir(folder)
                code, out, _ = reader(*shlex.split(command)[1:])
            assert code == 0, out
            folder.with_suffix(".txt").write_text(out)

        return once(f"page-{re.sub('[^a-z0-9]+', '-', command)}", fill)

    def typed(command: str) -> str:
        folder = made(command)
        shutil.copytree(folder, ".", dirs_exist_ok=True)
        return folder.with_suffix(".txt").read_text()

    return typed


class Followed:
    """A page as a reader follows it, who types what it has him type, in one folder."""

    def __init__(
        self, page: Path, reader: Harness, copied: Copied, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        self.page, self.reader, self.copied, self.monkeypatch = page, reader, copied, monkeypatch
        self.wrong: list[str] = []

    def all_but(self, left_out: tuple[str, ...], few: Path) -> None:
        """Follow it, but for the lines and blocks of Python that begin so."""
        for file, stands_for in {**READER_HAS, "few": few}.items():
            Path(file).symlink_to(stands_for)
        known: dict[str, Any] = {}
        for language, block in blocks(self.page):
            if language == "python":
                if not block.startswith(left_out):
                    exec(compile(block, self.page.name, "exec"), known)
                continue
            lines = typed(block)
            for (line, shown), (then, code_shown) in zip(
                lines, [*lines[1:], ("", "")], strict=True
            ):
                # A page that shows `echo $?` says how the line before it ends.
                says = int(code_shown.split()[0]) if then == "echo $?" else 0
                if not line.startswith(left_out):
                    self.line(line, shown, says)

    def line(self, line: str, shown: str, says: int) -> None:
        program, *args = shlex.split(line, comments=True)
        command = command_of(line)
        if program == "cd":
            self.monkeypatch.chdir(args[0])
        elif program == "export":
            self.monkeypatch.setenv(*args[0].split("=", 1))
        elif command in NOT_RUN:
            hold_against_options(args)
        elif program == "harness":
            if SHOWN[name(self.page)] and command in ONCE:
                code, out, problem = 0, self.copied(command), ""
            else:
                path, _ = parsed(args)
                cut = "" if shown.strip() else CUT.get(command, CUT.get(path, ""))
                code, out, problem = self.reader(*args, *cut.split())
            if lacks := re.search(r"needs (\S+), which is not installed", out + problem):
                pytest.skip(f"followed up to here: {line} needs {lacks[1]}")
            assert code == CUT_ENDS.get(command, says), f"{line}\n{out}\n{problem}"
            self.compare(line, shown, out)
        elif program in ("cp", "echo", "sed"):
            subprocess.run(line, shell=True, check=True)
        else:
            assert program in OTHER_PROGRAMS, line

    def compare(self, line: str, shown: str, out: str) -> None:
        """Note what is shown and was not printed."""
        if shown.strip() and (differs := difference(shown, out)):
            self.wrong.append(f"{line}\n{differs}")

    def end(self) -> None:
        if self.wrong:
            told = [f"{name(self.page)} shows what is not printed", *self.wrong]
            pytest.fail("\n\n".join(told), pytrace=False)


WRITTEN = [PAGE, *sorted(GROUPS.glob("*.md"))]  # by the program
FOLLOWABLE = [page for page in pages() if blocks(page)]


@pytest.mark.exhaustive
@pytest.mark.parametrize("page", FOLLOWABLE, ids=name)
def test_a_page_can_be_followed_and_shows_what_is_printed(
    page: Path, reader: Harness, copied: Copied, small_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    followed = Followed(page, reader, copied, monkeypatch)
    followed.all_but((), small_path)
    followed.end()


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in FOLLOWABLE if name(page) in FOLLOWED], ids=name)
def test_a_cheap_page_can_be_followed_and_shows_what_is_printed(
    page: Path, reader: Harness, copied: Copied, small_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    followed = Followed(page, reader, copied, monkeypatch)
    followed.all_but(FOLLOWED[name(page)], small_path)
    followed.end()


@pytest.mark.parametrize(
    "page",
    some([ROOT / "README.md"], exhaustive=[ROOT / "docs/tutorial-radio.md"]),
    ids=name,
)
def test_what_several_pages_show_is_printed(
    page: Path, reader: Harness, copied: Copied, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The runs of the first evaluation, which these pages show as well, and a sweep of it."""
    followed = Followed(page, reader, copied, monkeypatch)
    shared = [(line, shown) for line, shown in shell_of(page) if command_of(line) in ONCE]
    assert [bool(shown.strip()) for _, shown in shared].count(True) >= 2
    for line, shown in shared:
        followed.compare(line, shown, copied(command_of(line)))
    followed.end()


def test_every_line_of_every_page_is_one_that_the_program_takes() -> None:
    for line in TYPED:
        program, *args = shlex.split(line)
        if program == "harness":
            hold_against_options(args)
        else:
            assert program in (*OTHER_PROGRAMS, "cd", "cp", "echo", "export", "sed"), line


def test_what_is_excused_is_still_in_the_documents() -> None:
    assert {*NOT_RUN, *CUT_ENDS, *ONCE} <= set(TYPED)
    assert set(OTHER_PROGRAMS) <= {line.split()[0] for line in TYPED}
    assert set(CUT) <= {*COMMANDS, *TYPED}
    assert set(FOLLOWED) <= set(map(name, FOLLOWABLE))


def test_what_is_shown_is_compared() -> None:
    for page, lines in SHOWN.items():
        assert all(line.startswith("harness ") for line in lines), page
        assert not lines & {*NOT_RUN, *CUT_ENDS}, page


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("a 68.5\n", "a 68.5  \n\n", True),
        ("a 68.5\n", "a 68.6\n", False),
        ("a 68.5\n", "a 68.5\nb\n", False),
        ("b\n", "a\nb\n", False),
        ("…\nb\n…\n", "a\nb\n", True),
        ("a\n…\nc\n", "a\nb\nb\nc\n", True),
        ("a\n…\nc\n", "a\nb\nd\n", False),
        ("at … s\n", "at 0.1 (s) s\n", True),
        ("at … s\n", "at 0.1\ns\n", False),
    ],
)
def test_dots_stand_for_lines_or_text_and_all_else_is_compared(
    shown: str, printed: str, same: bool
) -> None:
    assert (difference(shown, printed) == "") == same


@pytest.mark.parametrize("page", MEASURED, ids=name)
def test_commands_that_measured_something_are_still_there(page: Path) -> None:
    for line in lines_of(page):
        program, *args = shlex.split(line)
        if program == "harness":
            hold_against_options(args)


@pytest.mark.parametrize("page", [*pages(), *WRITTEN, *MEASURED], ids=name)
def test_commands_named_in_a_sentence_are_taken_and_parts_of_them_exist(page: Path) -> None:
    prose = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    for mention in re.findall(r"`harness\s+([a-z][^`]*)`", prose):
        group, *rest = shlex.split(mention.replace("\\|", "|"))
        # `dataset build|check` are two commands.
        each = [[group, one, *rest[1:]] for one in rest[0].split("|")] if rest else [[group]]
        for args in each:
            path, words = parsed(args)
            options = {option for parameter in COMMANDS[path].params for option in parameter.opts}
            assert {word for word in words if word.startswith("--")} <= {*options, "--help"}, (
                mention
            )
            if is_whole(words):
                hold_against_options(args)


@pytest.mark.parametrize(
    ("said", "whole"),
    [
        ("", False), ("--against", False), ("--sft", False), ("RUN", False), (
            "NAME --agents all", False),
        ("SCENARIO...", False), (
            "--over x --grid 0,…", False), ("--latency 0.05", True), ("site", True),
    ],
)  # fmt: skip
def test_a_name_a_form_and_a_part_are_no_command_to_type(said: str, whole: bool) -> None:
    assert is_whole(said.split()) == whole


@pytest.mark.parametrize(
    "said",
    [
        "drive --latency 0.05",
        "eval --seeds 5:",
        "drive --shard 3/2",
        "eval --limit few",
        "study sweep",
    ],
)
def test_what_the_program_refuses_is_no_command(said: str) -> None:
    with pytest.raises((UserError, TyperException)):
        hold_against_options(said.split())


def test_the_reference_is_the_program_and_other_pages_type_its_examples() -> None:
    texts = reference()
    assert {page: page.read_text() for page in WRITTEN} == texts, "run `python docs/reference.py`"
    elsewhere = {line for page in pages() for line in lines_of(page)}
    for page in WRITTEN:
        assert set(lines_of(page)) <= elsewhere


@pytest.mark.parametrize(
    ("page", "written"),
    [
        (NAMES_PAGE, names),
        (SETTINGS_PAGE, settings),
        (FIELDS_PAGE, fields),
        (CARDS_PAGE, cards),
    ],
    ids=["names", "settings", "fields", "cards"],
)
def test_a_page_out_of_the_program_is_the_programs(page: Path, written: Callable[[], str]) -> None:
    assert page.read_text() == written(), "run `python docs/reference.py`"


def test_console_is_the_one_form_of_a_shell_block() -> None:
    for page in pages():
        assert not re.search(
            r"^```(sh|bash|shell|shell-session)", page.read_text(), re.MULTILINE
        ), page
        outside = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        assert not re.search(r"^ {4,}(\$ )?harness ", outside, re.MULTILINE), page


@pytest.mark.exhaustive
def test_the_site_has_no_broken_link_and_asks_no_other_host(tmp_path: Path) -> None:
    pytest.importorskip("sphinx", reason="needs the docs extra")
    pytest.importorskip("myst_parser", reason="needs the docs extra")
    pytest.importorskip("furo", reason="needs the docs extra")
    strict = ("--quiet", "--fail-on-warning", "--nitpicky")
    command = [sys.executable, "-m", "sphinx", *strict, "docs", str(tmp_path / "site")]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (built.returncode, built.stderr) == (0, "")
    loads = re.compile(
        r"""(<(link|script|img|iframe)\b[^>]*(href|src)="|@import ?["']|url\(["']?)(https?:)?//"""
    )
    files = [file for file in (tmp_path / "site").rglob("*") if file.suffix in (".html", ".css")]
    assert len(files) > len(pages())
    for file in files:
        assert not loads.search(file.read_text()), file
