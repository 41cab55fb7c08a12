"""`harness run export --every-eval`: every score of a run, as Every Eval Ever's schema has it."""

import json
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from run_on_disk import damage, made_up

from harness.core.files import digest
from harness.runs.folder import read

Harness = Callable[..., tuple[int, str, str]]
SCHEMA = Path(__file__).with_name("every_eval.schema.json")


def record_of(run: Path, harness: Harness) -> dict[str, Any]:
    assert harness("run", "export", run, "--every-eval", "record.json") == (0, "record.json\n", "")
    record = json.loads(Path("record.json").read_text())
    assert isinstance(record, dict)
    return record


def refuse_constant(name: str) -> None:
    raise ValueError(name)


@pytest.mark.parametrize("closed_loop", [False, True])
def test_a_record_has_each_score_with_its_interval_and_what_it_is_conditional_on(
    closed_loop: bool, tmp_path: Path, harness: Harness
) -> None:
    run = made_up(tmp_path / "run", closed_loop=closed_loop)
    record = record_of(run, harness)
    results = {each["evaluation_result_id"]: each for each in record["evaluation_results"]}
    details = record["source_metadata"]["additional_details"]
    unknown = json.loads(details["scores without a value"])
    scores, beside = read(run).scores, 0
    for score in scores:
        name = "/".join(score.key)
        if score.value is None:
            assert name in unknown
            assert name not in results
            continue
        if name not in results:  # the interval over seeds of a score that has another one
            assert score.interval == "seed means"
            beside += 1
            continue
        result = results[name]
        uncertainty = result["score_details"]["uncertainty"]
        assert (result["score_details"]["score"], uncertainty["num_samples"]) == (
            pytest.approx(score.value), score.n,
        )  # fmt: skip
        if score.low is None:
            assert "confidence_interval" not in uncertainty
        else:
            ends = uncertainty["confidence_interval"]
            assert (ends["lower"], ends["upper"]) == pytest.approx((score.low, score.high))
            assert ends["confidence_level"] == 0.95
        assert result["score_details"]["details"]["conditional on"] != "unknown"
        metric = result["metric_config"]
        assert float(metric["min_score"]) <= score.value <= float(metric["max_score"])
    success = results["6g/success_rate/episodes"]
    assert len(results) + len(unknown) + beside == len(scores)
    assert beside
    assert success["metric_config"]["metric_unit"] == "proportion"
    seeds = json.loads(success["score_details"]["details"]["interval over seeds"])
    assert (seeds["n"], seeds["confidence_interval"]["upper"]) == (2, 1.0)
    assert json.loads(details["what to know first"])


def test_a_record_names_model_prompt_and_dataset_by_digest_and_no_place_of_this_machine(
    tmp_path: Path, harness: Harness
) -> None:
    run = made_up(
        tmp_path / "run",
        model={"name": "mine", "engine": "transformers", "weights": "a/b", "sha256": "1" * 64},
        identity={"engine": "transformers", "revision": "2" * 40, "path": "/home/me/secret/w"},
        command="harness eval --out /home/me/secret/run",
    )
    record = record_of(run, harness)
    model, [result, *_] = record["model_info"], record["evaluation_results"]
    assert (model["id"], model["additional_details"]["sha256"]) == ("a/b", "1" * 64)
    prompt = json.loads(result["generation_config"]["additional_details"]["prompt"])
    assert (prompt["version"], prompt["sha256"]) == ("v2", "0" * 64)
    source = result["source_data"]
    assert (source["dataset_name"], source["additional_details"]["sha256"]) == ("made-up", "0" * 64)
    text = Path("record.json").read_text()
    assert "secret" not in text
    json.loads(text, parse_constant=refuse_constant)
    assert digest(record) == digest(record_of(run, harness))


def test_a_run_that_contradicts_itself_writes_no_record(tmp_path: Path, harness: Harness) -> None:
    run = made_up(tmp_path / "run")
    damage(run, episode=lambda row: row.update(success=False, failure="collision"))
    for more, reason in ((), "contradicts itself"), (("--dataset", "."), "leave it out"):
        code, out, err = harness("run", "export", run, "--every-eval", "record.json", *more)
        assert (code, out, err.count("\n"), Path("record.json").exists()) == (2, "", 1, False)
        assert reason in err


@pytest.mark.parametrize("closed_loop", [False, True])
def test_a_record_fits_the_published_schema(
    closed_loop: bool, tmp_path: Path, harness: Harness
) -> None:
    """Version 0.3.0, which lies beside this file without its descriptions."""
    schema = json.loads(SCHEMA.read_text())
    run = made_up(tmp_path / "run", closed_loop=closed_loop)
    record = record_of(run, harness)
    assert record["schema_version"] == schema["version"]
    jsonschema.Draft7Validator(schema).validate(record)


def test_the_schema_here_is_the_published_one() -> None:
    """`pip install --no-deps --ignore-requires-python every-eval-ever==0.3.0` brings that."""
    package = find_spec("every_eval_ever")
    if package is None or package.origin is None:
        pytest.skip("needs the package every-eval-ever")
    published = json.loads((Path(package.origin).parent / "schemas/eval.schema.json").read_text())
    here = json.loads(SCHEMA.read_text())
    del here["$comment"]
    assert here == bare(published)


def bare(value: Any) -> Any:
    """A schema without what is for people alone."""
    if isinstance(value, list):
        return [bare(each) for each in value]
    if not isinstance(value, dict):
        return value
    kept = {}
    for key, each in value.items():
        if key not in ("description", "$comment", "title", "examples") or isinstance(each, dict):
            kept[key] = bare(each)
    return kept
