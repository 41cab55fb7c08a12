"""Begin, resume and finish a run in its folder; a stopped run resumes with the same command."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from harness.backends.base import same_model, say_newly_stated
from harness.core import work
from harness.core.errors import UserError, printable
from harness.core.plugins import package_versions
from harness.core.versions import versions
from harness.evaluate import latency as latencies
from harness.evaluate.spec import Spec
from harness.runs import folder, formats
from harness.runs.formats import EXTENSIONS
from harness.runs.records import MEASURED, Latency, Manifest, Score
from harness.runs.settings import PLAIN, difference, of_words, words
from harness.runs.stopping import STOPPING_RULES, InterimLooks


class RunStart(work.WorkStart, frozen=True, kw_only=True):
    """Hold what a run begins with, kept in its working folder so that it resumes alike.

    `created` is when it began, UTC in ISO 8601; `command` has the words of the command that repeats
    it, and `tags` the user's words by which to find it. `identity` is all that decides the models'
    answers, as plain values by name; `latency` says how long these take, and `versions` has those
    of packages and code by name.
    """

    created: str  # when the run began, UTC, ISO 8601
    command: tuple[str, ...] = ()  # words of the command that repeats the run
    identity: dict[str, Any]  # all that decides the models' answers (`Backend.identity`)
    tags: tuple[str, ...]  # the user's tags
    latency: Latency  # how long the run's answers take
    # versions of the packages and of the code that the run may depend on
    versions: dict[str, str] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "settings", formats.upgraded(self.settings))
        msgspec.structs.force_setattr(self, "identity", formats.identity(self.identity))
        msgspec.structs.force_setattr(self, "versions", formats.versions(self.versions))

    def facts(self) -> dict[str, Any]:
        """Return what must be equal in all parts of a run that are made apart, by name for errors.

        Such parts are shards; each begins with a record like this.
        """
        versions = {
            f"version of {name}": v for name, v in self.versions.items() if name != "platform"
        }
        latency = msgspec.to_builtins(self.latency)
        return {
            **_comparable(self.settings),
            "model": self.identity,
            "inference times": latency,
            **versions,
        }


@dataclass(frozen=True)
class Evaluated:
    """Hold a finished run: its folder `out`, its manifest and its scores.

    `manifest` is the content of its `run.json`: settings and origin. `scores` are the lines of its
    `summary.csv`, one for each metric and condition (named set of settings that is scored).
    """

    out: Path  # the run's folder
    manifest: Manifest  # its settings and origin, the content of `run.json`
    scores: Sequence[Score]  # the lines of its `summary.csv`


def begin(
    spec: Spec,
    out: Path,
    run_start: RunStart | None,
    identity: dict[str, Any],
    latency: Latency,
    shard: str = "",
) -> RunStart:
    """Return the record of what a run begins with, or `run_start` if it resumes.

    Args:
        spec: the evaluation.
        out: the run's folder.
        run_start: the record that a stopped run kept in the folder; None without one.
        identity: all that decides the answers of the models opened now.
        latency: how long these models take to answer.
        shard: the part of a run, such as `1/3`; empty for all of it.

    Raises UserError if the run was begun with a model of another identity, or a condition cannot be
    used with this one.
    """
    spec.check_models(identity, latency)
    if run_start is None:
        return RunStart(
            settings=spec.record(),
            shard=shard,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            command=words(spec.settings),
            identity=identity,
            tags=spec.settings.tag,
            latency=latency,
            versions=versions(),
        )
    if not same_model(run_start.identity, identity):
        raise UserError(
            f"--out {printable(out)} was begun with {another_model(spec)}; delete it, or choose "
            "another folder"
        )
    say_newly_stated(f"--out {printable(out)}", run_start.identity, identity)
    return run_start


def another_model(spec: Spec) -> str:
    """Return a phrase for errors: a stopped run's model is another now, and in what.

    `spec` is the evaluation, whose models it names.
    """
    names = " or ".join(printable(card.name) for card in dict.fromkeys(spec.cards))
    differs = "files, package versions, number format or device"
    return f"another model behind {names} (its {differs} differ)"


def as_finished(spec: Spec, run_start: RunStart, looks: InterimLooks | None = None) -> RunStart:
    """Return the record of a run as it finishes, to write into its manifest.

    It has the tags of all commands that worked on it, the dataset's present path, and the times
    that were measured as if they had been typed, so that a repeat measures none. A run that stopped
    early (`looks`) also states after how many layouts.
    """
    spec = spec.changed(tag=tuple(dict.fromkeys((*run_start.tags, *spec.settings.tag))))
    # A repeat must not measure: other times would make other rows.
    if spec.settings.latency == MEASURED:
        spec = spec.changed(latency=latencies.as_declared(run_start.latency))
    evaluated = spec.stopped(looks) if looks else spec
    record = {**evaluated.record(), "settings": msgspec.to_builtins(spec.settings)}
    return msgspec.structs.replace(
        run_start,
        settings=record,
        tags=spec.settings.tag,
        command=words(spec.settings),
        versions=versions(),
    )


def unfinished(spec: Spec, out: Path, shard: str = "") -> RunStart | None:
    """Return what a stopped run in a folder began with; None if there is no such run.

    `spec` is the evaluation now, `out` the folder, and `shard` the part of the run, such as `1/3`,
    empty for all of it. Raises UserError if it is a run with other settings.
    """
    run_start = work.start_of(out, RunStart)
    if run_start:
        now = {**_comparable(spec.record()), "shard": shard}
        stored = {**_comparable(run_start.settings), "shard": run_start.shard}
        work.same(out, now, stored, partial(_options, spec, shlex.join(run_start.command)))
        work.same(out, rules(versions()), rules(run_start.versions))
        packages = package_versions()
        began_with = {name: run_start.versions.get(name, packages[name]) for name in packages}
        work.same(out, _of_packages(packages), _of_packages(began_with))
    return run_start


def _of_packages(versions: Mapping[str, str]) -> dict[str, str]:
    return {f"version of package {name}": version for name, version in versions.items()}


def _options(spec: Spec, command: str) -> str:
    """Return in which options a run's command differs from this one;
    empty for none, or no such command.
    """
    with suppress(UserError, ValueError):  # a stranger's run may state any command
        before, now = difference(of_words(shlex.split(command)), spec.settings)
        return before and f"{before}, and not with {now}"
    return ""


def rules(versions: Mapping[str, str]) -> dict[str, str]:
    """Return, of `versions` by name, those of the rules that turn answers into decisions.

    Shards, parts of a run that are made apart, must have the same.
    """
    return {f"version of {name}": versions[name] for name in formats.VERSIONS}


def resumable(spec: Spec, out: Path) -> bool:
    """Return whether this command can go on with the work in a folder, where no process works.

    `spec` is the command's evaluation. The work in `out` is that of this run, stopped, or of any
    run that was stopped before its first answer, or questions for another program wait there.
    """
    try:
        if work.waits(out):
            return True
        return (work.idle(out) or unfinished(spec, out) is not None) and not work.held(out)
    except UserError:
        return False


def refuse_finished(out: Path) -> None:
    """Raise UserError if a folder holds a finished run."""
    if (out / "run.json").exists():
        raise UserError(
            f"--out {printable(out)} already holds a finished run; choose another folder or delete "
            "it"
        )


def finished(spec: Spec, out: Path) -> Evaluated:
    """Return the finished run in a folder.

    Raises UserError if it has other settings than `spec`, or is damaged.
    """
    looks = folder.read(out).manifest.interim_looks if spec.stopping_rule else None
    evaluated = spec.stopped(looks) if looks else spec
    return finished_with(evaluated.record(), out, partial(_options, spec))


def finished_with(
    settings: Mapping[str, Any], out: Path, typed: Callable[[str], str] = lambda command: ""
) -> Evaluated:
    """Return the finished run in a folder, compared with the settings of an evaluation.

    `settings` are plain values by name, such as `Spec.record` returns. `typed` takes the run's
    command line and returns a phrase on the options in which this command differs, for the error.
    Raises UserError if the settings differ or the run is damaged.
    """
    run = folder.read(out)
    stored = msgspec.json.decode(msgspec.json.encode(run.manifest))
    command = run.manifest.command.rpartition(" --out ")[0]
    now, before = _comparable(settings), _comparable({key: stored[key] for key in settings})
    work.same(out, now, before, partial(typed, command))
    return Evaluated(out, run.manifest, run.scores)


def _comparable(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return what must be the same when a run resumes, by the names that an error gives it.

    Of its settings these are those that open nothing. The dataset's path is left out, since its
    folder may move between two commands, and what chooses a stopping rule, which the world states.
    What is no table, as in a damaged record, is another world.
    """
    parts = ("world", "settings", "beside")
    world, plain, opened = (_named(settings.get(name)) for name in parts)
    return {
        **{
            key: value
            for key, value in settings.items()
            if key not in ("world", "settings", "beside", *formats.BESIDE)
        },
        **{key: value for key, value in plain.items() if key in PLAIN},
        **STOPPING_RULES.without(_named(plain.get(EXTENSIONS))),
        **{f"content of {name}": value for name, value in opened.items()},
        **{f"{key} of the world": value for key, value in world.items() if key != "path"},
    }


def _named(table: Any) -> Mapping[str, Any]:
    return table if isinstance(table, Mapping) else {"kind": table}
