"""The helpers' agents: by which options they differ from the ego's, and what goes together."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from harness.backends import cards
from harness.backends.base import BARE
from harness.core.errors import UserError, printable
from harness.evaluate.agent import Agent
from harness.evaluate.spec import Spec
from harness.prompts import versions
from harness.runs.role_agents import RoleAgents
from harness.runs.settings import Settings


class Helpers(RoleAgents):
    """Choose who answers for helpers, where that is another agent than the ego's.

    An agent is a model with a prompt version and an answer mode; helpers are the vehicles that the
    ego asks. The settings in `chosen_by` name it: `helper_model` (one or more, by commas),
    `helper_prompt`, `helper_answer` and `helper_thinking`. Without any of them, the ego's agent
    answers for all. Methods are those of `RoleAgents`: they open the agents by these settings, and
    state them in a run's records.
    """

    chosen_by = ("helper_model", "helper_prompt", "helper_answer", "helper_thinking")

    def opened(self, settings: Settings, ego: Agent) -> tuple[Agent, ...]:
        model, version, answer, thinking = map(settings.extensions.get, self.chosen_by)
        if not (model or version or answer) and thinking is None:
            return ()
        prompt = versions.load(str(version)) if version else ego.prompt
        mode = answer or settings.answer
        names = str(model).split(",") if model else ()
        helper_cards = [cards.resolve(name.strip()) for name in names] or [ego.card]
        how: tuple[Any, ...] = (
            mode,
            settings.thinking if thinking is None else thinking,
            settings.image if prompt.image else "own",
            settings.letters if mode in BARE else None,
            settings.sums if mode == "json" else "refuse",
            settings.flip and mode in BARE,
        )
        with named({"--answer": answer, "--thinking": thinking}):
            return tuple(Agent(card, prompt, *how) for card in helper_cards)

    def settings(self, ego: Agent, agents: Sequence[Agent]) -> dict[str, Any]:
        thinking = any(agent.thinking and agent.card.thinking != "always" for agent in agents)
        settings: dict[str, Any] = {
            "helper_model": ",".join(cards.argument(agent.card) for agent in agents),
            "helper_prompt": agents[0].prompt.version,
            "helper_answer": agents[0].answer,
        }
        if thinking != ego.thinking:
            settings["helper_thinking"] = thinking
        return settings

    def recorded(self, agents: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        return {
            "helper_model": ",".join(agent["model"]["name"] for agent in agents),
            "helper_prompt": agents[0]["prompt"]["version"],
            "helper_answer": agents[0]["answer"],
        }

    def check(self, run: Spec) -> None:
        if not run.ego.can.asks_helpers:
            raise UserError(
                f"--model {printable(run.ego.card.name)}: it is a driver, which asks no helpers; "
                "give another model, or leave the helpers' options out"
            )
        drivers = [agent for agent in run.helpers if not agent.can.asks_helpers]
        if drivers and not run.several_decide:
            raise UserError(
                f"--helper-model: {printable(drivers[0].card.name)} is a driver, which decides for "
                "an ego only; give other models"
            )

    def unlike(self, run: Spec) -> str | None:
        version, form = run.ego.prompt.version, run.ego.prompt.helper_answer
        for prompt in (helper.prompt for helper in run.helpers):
            if prompt.helper_answer != form:
                return (
                    f"prompt {version} fuses messages with a {form}, those of {prompt.version} "
                    f"have a {prompt.helper_answer}; use another --helper-prompt"
                )
        return None


HELPERS = Helpers()


@contextmanager
def named(typed: Mapping[str, object]) -> Iterator[None]:
    """Enter a context in which a UserError about a helper's setting names the helper's option.

    So `--answer` in a message becomes `--helper-answer`. `typed` has the values that the user gave
    for helpers, by the ego's option, such as `--answer`; None where the ego's value holds.
    """
    try:
        yield
    except UserError as error:
        reason = str(error)
        if typed.get(reason.partition(" ")[0].rstrip(":")) is not None:
            reason = reason.replace("--", "--helper-", 1)
        raise UserError(
            reason if reason.startswith("--helper-") else f"helpers: {reason}"
        ) from None
