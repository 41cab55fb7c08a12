"""`harness model device`: the computers of a vehicle, what each rests on,
and what fits the window.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import typer

from harness.cli import options
from harness.cli.terminal import echo_each, echo_json, echo_text, table
from harness.core import resources
from harness.core.errors import UserError, in_range, printable
from harness.core.figures import Unit, interval_of, number_or_none

if TYPE_CHECKING:
    from harness.extensions.devices.fit import Fit
    from harness.extensions.devices.profiles import Constant, Device, DeviceRow


MOST_TOKENS = 1_000_000
MOST_MS = 60_000
Name = typer.Argument(
    help="Device profile; `harness model device list` shows them.", metavar="NAME"
)
Model = typer.Option(
    None,
    "--device-model",
    help="Row of the profile: a model's name, or a size such as 3b. Default: all rows.",
)


def list_devices(as_json: options.Json = False) -> None:
    """List the device profiles, which --device-profile takes."""
    from harness.extensions.devices import profiles

    def show(name: str, device: "Device") -> None:
        typer.echo(f"{printable(name)} · {', '.join(printable(row.model) for row in device.rows)}")
        typer.echo(f"  {printable(device.description, 78)}")

    echo_each(resources.each(profiles.names(), profiles.load), as_json, msgspec.to_builtins, show)


def show(
    name: str = Name,
    model: str | None = Model,
    run: Path | None = typer.Option(
        None, help="Folder of a run; take the token counts of its ego's answers."
    ),
    prompt_tokens: int = typer.Option(300, help="Without --run: tokens of a prompt."),
    answer_tokens: int = typer.Option(
        40, help="Without --run: tokens of an answer in json or constrained mode."
    ),
    window_ms: float = typer.Option(200.0, help="Decision window, in ms."),
    as_json: options.Json = False,
) -> None:
    """Show which answers fit the decision window on a device.

    It shows their time and energy, too. The time is that of the ego's own answer,
    without any message. Nothing else runs on the computer.
    """
    from harness.extensions.devices import profiles
    from harness.extensions.devices.fit import answers_of, declared, fits
    from harness.runs.contradictions import sound

    in_range("--prompt-tokens", prompt_tokens, 1, MOST_TOKENS)
    in_range("--answer-tokens", answer_tokens, 1, MOST_TOKENS)
    if not 0 < window_ms <= MOST_MS:
        raise UserError(
            f"--window-ms {window_ms:g} is out of range; give more than 0, to {MOST_MS}"
        )
    device = profiles.load(name)
    rows = [profiles.find_row(device, model)] if model else device.rows
    answers = answers_of(sound(run)) if run else declared(prompt_tokens, answer_tokens)
    results = fits(device, rows, answers, window_ms / 1000)
    if as_json:
        result = {
            "device": msgspec.to_builtins(device),
            "window_ms": window_ms,
            "run": run and str(run),
            "fits": [_as_mapping(fit) for fit in results],
        }
        echo_json(result)
        return
    typer.echo(f"{printable(device.name)} · {printable(device.description)}")
    if device.memory_gb:
        typer.echo(f"{device.memory_gb.value:g} GB of memory")
    typer.echo()
    in_time = "in time %" if run else f"in {window_ms:g} ms"
    lines = [_fit_cells(fit, of_run=run is not None) for fit in results]
    table(["model", "answer", "in + out", "ms", in_time, "J", "GB"], lines)
    typer.echo()
    if run:
        echo_text(
            f"{printable(run)}: n = {len(answers.prompt)} answers of {printable(answers.who)} for "
            "the ego; tokens and ms are medians, in time and J are means with 95 % intervals over "
            f"episodes; in time: within {window_ms:g} ms; readout: one token after the same "
            "prompts. Tokens are counted by the model's own tokenizer"
        )
    _origins(device, rows)


def _as_mapping(fit: "Fit") -> dict[str, Any]:
    return {
        "model": fit.row.model,
        "answer": fit.answer,
        "prompt_tokens": fit.prompt_tokens,
        "output_tokens": fit.output_tokens,
        "ms": number_or_none(1000 * fit.seconds),
        "in_time": fit.in_time,
        "joules": fit.joules,
        "memory_gb": fit.row.memory_gb and fit.row.memory_gb.value,
    }


def _fit_cells(fit: "Fit", of_run: bool) -> Sequence[str]:
    """Return a line of the table of fits; of a run's answers shares and joules have intervals."""
    unit = Unit("J", 2)
    if of_run:
        in_time, joules = interval_of(fit.in_time), interval_of(fit.joules, unit)
    else:
        in_time, joules = "yes" if fit.in_time.value else "no", unit.number(fit.joules.value)
    decimals = 0 if fit.seconds >= 0.1 else 1
    return (
        printable(fit.row.model),
        fit.answer,
        f"{fit.prompt_tokens:g} + {fit.output_tokens:g}",
        _or_unknown(fit.seconds, f"{1000 * fit.seconds:.{decimals}f}"),
        _or_unknown(fit.in_time.value, in_time),
        _or_unknown(fit.joules.value, joules),
        f"{fit.row.memory_gb.value:.2g}" if fit.row.memory_gb else "unknown",
    )


def check(
    name: str = Name,
    run: Path = typer.Argument(
        help="Folder of a run made with --batch-size 1 --no-cache.", metavar="RUN"
    ),
    model: str | None = typer.Option(
        None,
        "--device-model",
        help="Row of the profile to check. Default: that of the run's model.",
    ),
    as_json: options.Json = False,
) -> None:
    """Compare a device profile with a run's measured times.

    Run it on the device itself. On another machine, the figures show how far the two are apart.
    """
    from harness.extensions.devices import profiles
    from harness.extensions.devices.fit import held
    from harness.runs.contradictions import sound
    from harness.runs.records import role_word

    device, done = profiles.load(name), sound(run)
    row = profiles.find_row(device, model or str(done.manifest.model["name"]).partition(":")[0])
    results = held(device, row, done)
    if as_json:
        echo_json(results)
        return
    scales = {
        "seconds": ("answer, ms", 1000.0),
        "prefill_tokens_per_s": ("prefill, tokens/s", 1.0),
        "decode_tokens_per_s": ("decoding, tokens/s", 1.0),
    }
    lines = []
    for result in results:
        what, factor = scales[result.what]
        measured = interval_of(result.measured, Unit(factor=factor))
        profile_says = _or_unknown(result.stated, f"{result.stated * factor:.1f}")
        role, n = role_word(result.role), str(result.measured.n)
        lines.append((role, what, measured, profile_says, n))
    table(["role", "what", "measured", f"{printable(device.name)} says", "n"], lines)
    echo_text(
        "medians of answers asked alone, with 95 % intervals over episodes; "
        f"{printable(row.model)}'s row"
    )
    _origins(device, [row])


def measure(
    model: str = typer.Option("swarm-tiny", help="Model: a card name, or a folder of weights."),
    engine: options.Engine = None,
    prompt: options.Prompt = "v2",
    answer: options.Answer = "json",
    window_s: float = typer.Option(
        2.0, help="Length of each of the five measurements in s, at least."
    ),
    device: options.Device = None,
    as_json: options.Json = False,
) -> None:
    """Measure the energy of a model's answers on this machine.

    The meters are NVML, RAPL and a Jetson's rails; `harness model doctor` lists those that can be
    read. Each measurement first idles, then asks one question after the other for as long.
    """
    from harness.backends import cards
    from harness.backends.counters import counters
    from harness.cli.progress import bar
    from harness.evaluate.agent import Agent
    from harness.extensions.devices.power import WINDOWS, measure_agent
    from harness.prompts import versions

    if not 0.1 <= window_s <= MOST_MS / 1000:
        raise UserError(f"--window-s {window_s:g} is out of range; give 0.1 to {MOST_MS // 1000}")
    meters = counters()
    if not meters:
        raise UserError(
            "harness model device measure: no meter can be read here: NVML needs an NVIDIA GPU and "
            "the nvidia-ml-py, RAPL needs root; state joules in devices/NAME.toml with their source"
        )
    card = cards.load(f"{model}:{engine}" if engine else model)
    agent = Agent(card, versions.load(prompt), answer)
    with bar("windows", WINDOWS, quiet=as_json) as progress:
        powers, n = measure_agent(agent, meters, window_s, device, progress)
    if as_json:
        result = {
            "model": agent.name,
            "answers": n,
            "windows": WINDOWS,
            "window_s": window_s,
            "meters": powers,
        }
        echo_json(result)
        return
    typer.echo(f"{printable(agent.name)} · {n} answers, one by one")
    watts, joules = Unit("W", 2), Unit("J", 3)
    lines = []
    for power in powers:
        name, idle = printable(power.meter), f"{power.idle_watts:.2f}"
        of_answer, above_idling = (
            interval_of(power.answer_j, joules),
            interval_of(power.more_j, joules),
        )
        lines.append((name, idle, interval_of(power.watts, watts), of_answer, above_idling))
    table(["meter", "idle W", "asking W", "J an answer", "J above idling"], lines)
    echo_text(
        f"means of {WINDOWS} windows of {window_s:g} s or more, with 95 % intervals over them; a "
        "meter counts all that draws from it, other programs and idling included"
    )


def _origins(device: "Device", rows: "Sequence[DeviceRow]") -> None:
    """Print what the numbers rest on, each source once."""
    from harness.extensions.devices.profiles import APART, JOULES, RATES, constants

    kinds = {"times": (*RATES, "answer_ms"), "J": tuple(JOULES), "GB": ("memory_gb",)}
    sources: dict[str, dict[str, None]] = {head: {} for head in kinds}
    for row in rows:
        apart = [(name, getattr(row, name)) for name in APART]
        for name, constant in (*constants(device, row), *apart):
            source = constant and f"{constant.status} ({_source(device, constant)})"
            for head, names in kinds.items():
                if source and name in names:
                    sources[head][source] = None
    for head, of_head in sources.items():
        echo_text(f"{head}: {'; '.join(of_head) or 'unknown, since nobody states them'}")
    echo_text(f"power mode: {device.power_mode}")


def _source(device: "Device", constant: "Constant") -> str:
    watts = device.load_watts
    if watts and constant.source.endswith(watts.source):  # the rate is in the table
        return f"{watts.value:g} W over the rate: {watts.source}"
    return constant.source


def _or_unknown(value: float, text: str) -> str:
    return "unknown" if value != value else text
