"""The trees' rewards in TRL and in verifiers, by these packages; each is an extra, in no other."""

import asyncio
from pathlib import Path
from typing import Any

import pytest

import harness as package

pytestmark = pytest.mark.filterwarnings("default")
STATED = '{{"action_distribution":{{"SLOWER":{},"IDLE":{},"FASTER":{}}}}}'


@pytest.mark.exhaustive  # the rewards themselves: `test_rewards.py`
def test_grpo_takes_steps_on_exact_rewards(small_path: Path, tmp_path: Path) -> None:
    trl = pytest.importorskip("trl", reason="needs the trl extra")
    datasets = pytest.importorskip("datasets", reason="needs the trl extra")
    from transformers import AutoTokenizer

    env = package.environment(dataset=small_path, prompt="v4", then="uniform")
    rewards: list[float] = []

    def watched(*args: Any, **columns: Any) -> list[float]:
        rewards.extend(env.expected_advantage(*args, **columns))
        return rewards[-len(columns["values"]) :]

    model = str(Path(__file__).parents[3] / "models/swarm-tiny")
    trainer = trl.GRPOTrainer(
        model=model,
        processing_class=AutoTokenizer.from_pretrained(model),
        reward_funcs=watched,
        train_dataset=datasets.Dataset.from_list(env.rows(per_level=2)),
        args=trl.GRPOConfig(
            output_dir=str(tmp_path / "out"), max_steps=2, num_generations=4, per_device_train_batch_size=4,
            max_completion_length=80, use_cpu=True, bf16=False, report_to="none", temperature=1.0, seed=1,
        ),
    )  # fmt: skip
    trained = trainer.model.model.embed_tokens.weight
    before = trained.detach().clone()
    assert trainer.train().global_step == 2
    assert len(rewards) == 8
    assert -1 <= min(rewards) <= max(rewards) <= 1
    assert len({*rewards}) > 1, "samples of one prompt differ, so there is something to learn"
    assert (trained != before).any()


@pytest.fixture
def taskset(small_path: Path) -> Any:
    pytest.importorskip("verifiers", reason="needs the verifiers extra")
    from verifiers.v1.utils.loaders import load_taskset, taskset_config_type

    config = taskset_config_type("swarmdrive-trees")
    return load_taskset(
        config(id="swarmdrive-trees", dataset=str(small_path), viewer="any", per_level=2)
    )


def trace_of(task: Any, text: str) -> Any:
    import verifiers.v1 as vf
    from verifiers.v1.graph import MessageNode
    from verifiers.v1.trace import AgentInfo, TraceTask

    said = MessageNode(message=vf.AssistantMessage(content=text), sampled=True)
    about = TraceTask(type="DecisionTask", data=task.data, key=task.key, hash=task.hash)
    return vf.Trace(task=about, agent=AgentInfo(config=vf.AgentConfig()), nodes=[said])


@pytest.mark.slow
def test_verifiers_scores_a_trace_as_the_trees_do(taskset: Any, small_path: Path) -> None:
    env = package.environment(dataset=small_path, viewer="any")
    tasks, rows = [*taskset], env.rows(per_level=2)
    assert len(tasks) == len(rows)
    for task, row in list(zip(tasks, rows, strict=True))[::5]:
        asked = [{"role": "system", "content": task.data.system_prompt}]
        asked += [{"role": m.role, "content": m.content} for m in task.data.prompt]
        assert asked == row["prompt"]
        if row["role"] == "helper":
            continue
        for text, worth, readable in (
            (
                STATED.format(0.5, 0.25, 0.25),
                row["values"][0] - row["values"][row["constant"]],
                1.0,
            ),
            ("no idea", -row["values"][row["constant"]], 0.0),
        ):
            trace = trace_of(task, text)
            asyncio.run(task.score(trace))
            assert trace.rewards["advantage"].value == pytest.approx(worth)
            assert trace.metrics["readable"] == readable


@pytest.mark.slow
def test_verifiers_makes_an_environment_of_it_and_report_seeds_are_one_line(taskset: Any) -> None:
    from verifiers.v1.utils.loaders import load_environment, load_taskset, resolve_env_config

    config = {"taskset": {"id": "swarmdrive-trees", "scenario": "blind-merge", "seeds": "report"}}
    env = load_environment(resolve_env_config(config))
    assert type(env.taskset).__name__ == "SwarmdriveTrees"
    assert env.taskset.task_type().__name__ == "DecisionTask"
    with pytest.raises(package.UserError, match="numbers are reported of"):
        next(iter(load_taskset(env.config.taskset)))
    assert type(taskset) is type(env.taskset)
