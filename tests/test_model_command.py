"""`harness model list` and `harness model check`, as typed."""

import json
import sys
from pathlib import Path

import pytest

from harness import cards, cli


def harness(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *args: str
) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command line."""
    monkeypatch.setattr(sys, "argv", ["harness", *args])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return (int(ended.value.code or 0), *capsys.readouterr())


def test_the_list_has_every_card_in_eighty_columns(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = harness(monkeypatch, capsys, "model", "list")
    assert code == 0
    assert max(map(len, out.splitlines())) <= 80
    listed = {line.split()[0]: line for line in out.splitlines() if not line.startswith((" ", "name"))}
    assert sorted(listed) == cards.names()
    assert "card 145 ms" in listed["proxy"]
    assert "yes" in listed["proxy"]
    assert "measured" in listed["qwen3-4b"]


def test_the_json_list_is_the_cards_with_what_they_lack(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = harness(monkeypatch, capsys, "model", "list", "--json")
    assert code == 0
    rows = {row["name"]: row for row in json.loads(out)}
    assert rows["proxy"]["latency"]["inference_s"] == 0.145
    assert rows["proxy"]["missing"] is None
    assert rows["full-view"]["privileged"] is True


def test_a_model_free_engine_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = harness(monkeypatch, capsys, "model", "check", "proxy")
    assert (code, out) == (0, "proxy: engine proxy is model-free: no weights, no tokens, nothing to load\n")
    code, out, _ = harness(monkeypatch, capsys, "model", "check", "brake", "--json")
    assert json.loads(out) == {"name": "brake", "engine": "driver", "model_free": True}


def test_a_misspelt_model_is_one_line_and_exit_code_two(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = harness(monkeypatch, capsys, "model", "check", "proxi")
    assert (code, out) == (2, "")
    assert err.startswith("harness: unknown model 'proxi'; did you mean 'proxy'?")
    assert err.count("\n") == 1


def test_without_the_extra_the_list_says_what_is_missing_and_a_check_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)  # as python sees a package that is not installed
    code, out, _ = harness(monkeypatch, capsys, "model", "list")
    assert code == 0
    assert "no: torch" in out
    code, _, err = harness(monkeypatch, capsys, "model", "check", "qwen3-4b")
    assert code == 2
    assert "needs torch" in err
    assert "pip install 'swarmdrive-harness[transformers]'" in err


def test_a_check_shows_prompt_tokens_thinking_and_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch", reason="needs the transformers extra")
    import tiny_qwen3

    folder = str(tiny_qwen3.build(tmp_path / "tiny"))
    capsys.readouterr()
    code, out, err = harness(monkeypatch, capsys, "model", "check", folder, "--device", "cpu")
    assert (code, err) == (0, "")
    for part in (
        "float32 on cpu",
        "0 of them BOS",
        "switch; not asked",
        "  | <|im_start|>system",
        " ms for ",
    ):
        assert part in out

    code, out, _ = harness(
        monkeypatch, capsys, "model", "check", folder, "--device", "cpu", "--thinking", "--json"
    )
    seen = json.loads(out)
    assert code == 0
    assert seen["thinking_asked"] is True
    assert seen["prompt"].endswith("<|im_start|>assistant\n")
    assert seen["completion"]["batch_size"] == 1
    assert seen["identity"]["engine"] == "transformers"
