"""The model card: a record of a model, its engine, its weights and its latency,
and the file that holds it.

A file, `models/<name>.toml`, may list further engines:
`<name>:<engine>` is the same model on that one.
"""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from harness.backends.answered_prompts import Readable
from harness.backends.base import Letters
from harness.backends.price import Price
from harness.backends.registry import ENGINES
from harness.backends.servers import Server
from harness.backends.vision import Vision
from harness.core.config import Count, Seconds, convert, toml
from harness.core.errors import UserError, printable, unknown

Dtype = Literal["float32", "bfloat16", "auto"]
Thinking = Literal["none", "switch", "always"]
System = Literal["first-user"]
LatencySource = Literal["card", "cited", "paper"]
Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z", description="64 digits 0-9 a-f")]
Share = Annotated[float, Meta(ge=0, le=1, description="a share, 0 to 1")]

# Keys that only some engines understand; a `Registration` says which.
_ENGINE_KEYS = (
    "weights",
    "server",
    "revision",
    "sha256",
    "gated",
    "dtype",
    "file",
    "quantisation",
    "failures",
    "privileged",
    "vision",
    "projector",
    "system",
    "adapter",
    "price",
)
# Keys that a model may set again for each further engine.
_PER_ENGINE = (
    "latency",
    "weights",
    "file",
    "revision",
    "sha256",
    "gated",
    "dtype",
    "quantisation",
    "server",
    "projector",
    "adapter",
    "price",
)


@dataclass(frozen=True)
class Latency:
    """Hold the time that a model card (a model's TOML file) declares for one answer of its model.

    `source` says which time a run takes: `card` is the declared `inference_s`, in seconds; `paper`
    is the 145 ms of the paper that this benchmark repeats, where none is declared; `cited` is also
    the paper's, unless the user asks for the card's. `inference_s` is None if the paper's is taken.
    `basis` says in words where the number comes from.
    """

    # `card` means `inference_s`; `paper` means the 145 ms of the paper, if no time is declared;
    # `cited` too means those 145 ms unless the card's time is asked for, since the time was
    # measured on a computer that is not a car's
    source: LatencySource
    inference_s: Seconds | None  # declared or cited seconds of one answer; None for the paper's
    # where the number comes from: "cited: ...", "declared: ...", or "measured: machine, date"
    basis: str

    def __post_init__(self) -> None:
        if (self.source == "paper") == (self.inference_s is not None):
            raise ValueError('inference_s goes with source = "card" or "cited", and only with them')


@dataclass(frozen=True)
class Failures:
    """Hold the shares of a rule's answers that are spoilt on purpose, drawn for each request.

    They are for the engine `proxy`, a rule in place of a model, to test parsing and repair. A text
    is spoilt in one way at most; any answer may be slow as well. The intent (the actions'
    probabilities) is recovered from an answer in a code `fence` or among `prose`; parsing fails on
    one that is cut off (`truncation`), has a probability NaN (`nan`) or an action that is none
    (`unknown_action`), or never ends its thought (`unclosed_think`). The share `slow_tail` takes
    `slow_s` seconds longer than the card's latency.
    """

    fence: Share = 0.0  # the answer is in a code fence. Recovered.
    prose: Share = 0.0  # the answer is between sentences. Recovered.
    truncation: Share = 0.0  # the answer is cut off inside its JSON. Failed, `truncated_json`.
    nan: Share = 0.0  # one probability is NaN. Failed, `non_finite`.
    # no action's name is one of the scenario's. Failed, `unknown_action`.
    unknown_action: Share = 0.0
    # the answer is in a thought that never ends. Failed, `truncated_reasoning`.
    unclosed_think: Share = 0.0
    slow_tail: Share = 0.0  # the answer takes `slow_s` seconds longer than the card's latency
    slow_s: Seconds = 0.0  # how much longer the share `slow_tail` takes

    def __post_init__(self) -> None:
        if (total := sum(self.texts.values())) > 1 + 1e-9:
            raise ValueError(f"the shares of spoilt texts sum to {total:.4g}; allowed: 1 at most")
        if (self.slow_tail > 0) != (self.slow_s > 0):
            raise ValueError("slow_tail and slow_s go together; give both, or neither")

    @property
    def texts(self) -> dict[str, float]:
        """Return the shares of answers, 0 to 1, whose text is made to fail, by kind of failure.

        Slow answers, whose text is as it would be, are left out.
        """
        return {name: rate for name, rate in asdict(self).items() if not name.startswith("slow_")}


@dataclass(frozen=True)
class Card:
    """Describe one model on one engine, as a model card does: a TOML file `models/<name>.toml`.

    An engine is the program that runs the model: transformers, llama.cpp, a server, or a rule.
    `weights` is where the model is: a directory, a GGUF file or a hub id, of which `file`,
    `revision` and `sha256` say more, and `gated` that its licence must be accepted there; a run's
    folder for the engine `replay`, the model's name at a server. `dtype` is the number format of
    its weights, `quantisation` that of a GGUF file, for people, and `licence` names theirs;
    `context_tokens` is the most tokens of prompt and answer together, `max_new_tokens` the most of
    an answer.

    `latency` is the declared time of an answer, and `privileged` says that the model sees behind
    the occlusion, as an upper reference. `thinking` says whether its template can open a thought,
    for at most `thinking_tokens`. `vision` says how it takes pictures, by the file `projector`;
    `adapter` is the folder of a LoRA adapter. `system` says where the system text goes, `letters`
    whether an answer by the probabilities of one letter an action is averaged over orders of the
    actions, and `prompts` which prompts the model was seen to answer. `server`, `failures` and
    `price` are tables for the engines that have them; None is none, or unknown.
    """

    # what is typed after `--model` to get it: the name of its file without `.toml`, that with
    # `:<engine>`, the name of a directory or file, a hub id, or `replay:<run>`
    name: str
    engine: str  # name of the program that runs it, such as `transformers`
    description: str  # one line for people
    latency: Latency  # the declared time of one answer
    # Where the model is: a directory (absolute, or relative to the cards' folder), a GGUF file or a
    # hub id; the run's directory for engine `replay`, the server's name of the model for `openai`.
    # None without a model.
    weights: str | None = None
    # name of the GGUF file inside `weights`; None if `weights` is the file itself
    file: str | None = None
    revision: str | None = None  # branch, tag or commit on the hub; None means its default branch
    # of the GGUF file, of all that it was split into, or of model.safetensors; checked on loading
    sha256: Sha256 | None = None
    # whether the hub gives the weights only to those who have accepted their licence
    gated: bool = False
    # number format of a checkpoint's weights; `auto` is the engine's choice, on transformers the
    # checkpoint's own on a GPU, and on a CPU bfloat16 where it multiplies in it, else float32
    dtype: Dtype = "auto"
    # number format of a GGUF file, for people only; the file decides
    quantisation: str | None = None
    # most tokens of prompt and answer; None: the checkpoint's own limit
    context_tokens: Count | None = None
    # `switch` if its template can turn it on and off, `always` if never off
    thinking: Thinking = "none"
    # whether it is shown what is hidden from the vehicle: an upper bound to compare with, no
    # contestant
    privileged: bool = False
    licence: str | None = None  # SPDX id of the weights' licence, or its name if it has no id
    # most tokens of an answer, if the model needs another limit than its prompt's; None for that
    max_new_tokens: Count | None = None
    # most tokens of a thought, in addition to the answer's, if asked to think
    thinking_tokens: Count = 2048
    server: Server | None = None  # the server of an `openai` model
    failures: Failures | None = None  # how often the proxy fails on purpose
    vision: Vision | None = None  # how the model takes pictures; None if it only reads text
    # name of the GGUF file beside `file` that turns pictures into tokens
    projector: str | None = None
    # folder of a LoRA adapter, absolute or beside the cards, that changes the weights; None without
    adapter: str | None = None
    # `first-user` puts the system text at the beginning of the first user turn, for a chat template
    # that has no place for it; None gives it a message of its own.
    system: System | None = None
    # `raw` for a model that was trained on one order of the letters; None, or `cyclic`, averages a
    # read-out over their orders, unless `--letters` says otherwise.
    letters: Letters | None = None
    price: Price | None = None  # what its tokens cost; None if it costs nothing, or nobody says
    # prompts that it was seen to answer, by fixed questions; the first is taken where none is typed
    # and the scenario's is not among them
    prompts: tuple[Readable, ...] = ()

    @property
    def slow_s(self) -> float:
        """Return the seconds that some answers of a rule take longer than its latency.

        The card's `failures` declare it, to test late answers; it is 0 without any.
        """
        return self.failures.slow_s if self.failures else 0.0

    @property
    def shown(self) -> str:
        return f"model {printable(self.name)!r}"

    def at(self, urls: tuple[str, ...]) -> "Card":
        """Return a copy of this card whose model is asked at other addresses of its servers.

        `urls` are base URLs such as `http://host:8000/v1`. The card is unchanged if it has no
        server or `urls` is empty. Raises ValueError if one is not a base URL, or is named twice.
        """
        return (
            replace(self, server=replace(self.server, base_url=urls))
            if self.server and urls
            else self
        )

    def record(self) -> dict[str, Any]:
        """Return the model card, what a model's TOML file states, as plain values by key.

        A run's record has them; `core.config.convert` makes the card of them again.
        """
        record = asdict(self)
        del record["letters"]  # the agent's settings say how its letters are read
        for name in ("adapter", "price", "prompts"):
            if not record[name]:
                del record[name]
        if self.server:
            server = {key: value for key, value in record["server"].items() if value is not None}
            if self.server.fields:
                server["fields"] = dict(self.server.fields.changed)
            record["server"] = server
        return record


@dataclass(frozen=True)
class _File(Card):
    """The content of a card file: a card, and what is different on other engines."""

    engines: dict[str, Any] = field(default_factory=dict)


def read_cards(path: Path) -> list[Card]:
    """Return the model cards of a TOML file, one for each engine that it lists.

    The default engine's is first. Raises UserError for a mistake in the file.
    """
    where = f"model card {path}"
    table = _with_latency(toml(path, where))
    engines = convert(table, _File, where, name=path.stem).engines
    table.pop("engines", None)
    cards = [_card(table, where, path.stem)]
    shared = {key: value for key, value in table.items() if key not in _PER_ENGINE}
    if cards[0].latency.source == "paper":  # a declared latency does not hold for another engine
        shared["latency"] = table["latency"]
    for engine, settings in engines.items():
        at = f"{where} [engines.{printable(engine)}]"
        registered = None if engine == table["engine"] else ENGINES.get(engine)
        if registered is None or "weights" not in registered.allowed_keys:
            allowed = [name for name in _engines_with("weights") if name != table["engine"]]
            raise unknown(f"engine in {where}", engine, allowed)
        if not isinstance(settings, dict):
            raise UserError(f"{at} = {printable(settings)!r}; allowed: a table")
        for key in settings:
            if key not in _PER_ENGINE:
                raise unknown(f"key in {at}", key, _PER_ENGINE)
        # An adapter changes the same weights here, too: without it this would be another model, so
        # an engine that takes none is refused.
        adapter = {key: table[key] for key in table.keys() & {"adapter"}}
        whole = _with_latency({**shared, **adapter, **settings, "engine": engine})
        cards.append(_card(whole, at, f"{path.stem}:{engine}"))
    return cards


def _with_latency(table: dict[str, Any]) -> dict[str, Any]:
    """Add to a card's table the `inference_s` that is left out if no time is declared."""
    latency = table.get("latency")
    return (
        {**table, "latency": {"inference_s": None, **latency}}
        if isinstance(latency, dict)
        else table
    )


def _card(table: dict[str, Any], where: str, name: str) -> Card:
    card = convert(table, Card, where, name=name)
    if (engine := ENGINES.get(card.engine)) is None:
        raise unknown(f"engine in {where}", card.engine, ENGINES)
    for key in _ENGINE_KEYS:
        lacking = key in engine.required_keys and key not in table
        if lacking or (key in table and key not in engine.allowed_keys):
            shown_key = f"[{key}]" if key in ("server", "failures", "vision", "price") else key
            if lacking:
                raise UserError(f"{where}: {shown_key} is missing; engine = {card.engine} needs it")
            takers = " or ".join(_engines_with(key))
            raise UserError(f"{where}: {shown_key} goes with engine = {takers}, and only with it")
    if "projector" in engine.allowed_keys and bool(card.vision) != bool(card.projector):
        raise UserError(
            f"{where}: [vision] and projector go together on {card.engine}: give the name of its "
            "mmproj file, or leave both out"
        )
    if card.server and card.thinking == "switch" and not card.server.tells_thinking:
        raise UserError(
            f'{where} [server]: thinking = "switch" needs the kind vllm or llama-server, which a '
            "request can "
            "tell; else set it at the server, and here none or always"
        )
    if card.failures and card.failures.slow_tail and card.latency.source != "card":
        raise UserError(
            f'{where} [failures]: a slow tail goes with a latency whose source = "card"'
        )
    return card


def _engines_with(key: str) -> list[str]:
    return [
        engine for engine, registered in ENGINES.usable().items() if key in registered.allowed_keys
    ]
