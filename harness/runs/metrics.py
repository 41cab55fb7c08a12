"""The registry of metrics: those of the core, of extensions and of other packages, by name.

A package adds a metric by an entry point in the group `swarmdrive.metrics`.
"""

from collections.abc import Iterator, Mapping
from functools import cached_property, lru_cache
from itertools import takewhile
from math import inf
from typing import ClassVar, get_args

from harness.core.errors import UserError, printable
from harness.core.figures import Unit
from harness.core.plugins import Plugins, of_type, one_of
from harness.runs.answer_metrics import answer_metrics
from harness.runs.built_in_metrics import BUILT_IN
from harness.runs.metric import SCORE, Better, Metric, World
from harness.runs.records import roles


class Metrics(Plugins[Metric]):
    """Hold all metrics by name: built-in ones, those of extensions, and other packages'.

    `stated` has a rule for each attribute of a metric that a package adds: a test of its value, and
    words for what is allowed.
    """

    # what packages' metrics must have, by attribute: a test of its value, and words for what is
    # allowed
    stated: ClassVar = {
        "meaning": of_type(str),
        "label": of_type(str),
        "unit": of_type(Unit),
        "better": one_of(*get_args(Better)),
        "interval": one_of("rate", "mean"),
        "most": of_type(float),
        "world": one_of(None, *get_args(World)),
    }

    @cached_property
    def of_harness(self) -> Mapping[str, Metric]:
        """Return the metrics that the harness defines, by name, in the order of a summary's rows.

        Those that other packages add are left out.
        """
        of_answers = {metric.name: metric for metric in answer_metrics(roles())}
        before = takewhile(lambda name: name not in of_answers, self.built_in)
        core = {**{name: self.built_in[name] for name in before}, **of_answers, **self.built_in}
        of_extensions = [super(Metrics, self).__getitem__(name) for name in self._shipped()]
        ordered: dict[str, Metric] = {}
        for name, metric in core.items():
            ordered[name] = metric
            ordered |= {each.name: each for each in of_extensions if each.behind == name}
        return ordered

    def _shipped(self) -> list[str]:
        entries = self._entries()
        return [name for name in entries if self.is_ours(name) and name not in self.built_in]

    def __getitem__(self, name: str) -> Metric:
        return self.of_harness[name] if name in self.of_harness else super().__getitem__(name)

    def __iter__(self) -> Iterator[str]:
        return iter({**self.of_harness, **self._entries()})

    def check(self, name: str, plugin: Metric) -> None:
        functions = [each for each in (plugin.decisions, plugin.episodes) if each]
        if plugin.name != name or not name.isidentifier() or len(functions) != 1 or plugin.primary:
            raise UserError(
                f"plug-in {printable(name)!r} ({self.group}) is the metric "
                f"{printable(plugin.name)!r} with {len(functions)} "
                f"functions{', a primary one' * plugin.primary}; give it the name of its entry "
                "point, of letters, digits and _, and one function, of decisions or of episodes; "
                "a package's metric is not primary"
            )
        unit = plugin.unit
        is_plain = type(unit) is Unit and isinstance(unit.name, str) and unit.name.isprintable()
        if not is_plain or not (0 < unit.factor < inf and unit.decimals in range(10)):
            raise UserError(
                f"plug-in {printable(name)!r} ({self.group}): its unit is {printable(unit, 80)}; "
                "give a Unit with a name that terminals show, a factor above 0 and 0 to 9 decimals"
            )
        unit.text(0.5)  # which fails here, and not where a page is written


METRICS = Metrics("swarmdrive.metrics", Metric, {metric.name: metric for metric in BUILT_IN})


def metrics_of(world: World) -> tuple[Metric, ...]:
    """Return the metrics of decisions and of episodes that are known in a kind of world.

    `world` is `frozen` (recorded scenes) or `closed-loop`. Raises UserError if a package's metric
    does not load.
    """
    by_row = (metric for metric in METRICS.values() if metric.decisions or metric.episodes)
    return tuple(metric for metric in by_row if metric.world in (None, world))


@lru_cache(1024)
def entry(name: str) -> Metric:
    """Return the metric of a name; for one that is unknown here, a plain one without a meaning.

    Such a name may stand in a run that another version of the harness made.
    """
    try:
        return METRICS[name]
    except (KeyError, UserError):
        return Metric(name, "", SCORE, "neither")
