"""The model card: a record of a model, its engine, its weights and its latency."""

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from harness.backends.base import Letters
from harness.backends.failures import Failures
from harness.backends.servers import Server
from harness.backends.vision import Vision
from harness.core.config import Count, Seconds
from harness.core.errors import printable

Dtype = Literal["float32", "bfloat16", "auto"]
Thinking = Literal["none", "switch", "always"]
System = Literal["first-user"]
LatencySource = Literal["card", "paper"]
Sha256 = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z", description="64 digits 0-9 a-f")]


@dataclass(frozen=True)
class Latency:
    """Declared time of one answer."""

    source: LatencySource  # `card` means `inference_s`, `paper` the paper's 145 ms if no time is declared
    inference_s: Seconds | None  # declared seconds of one answer; None for the paper's
    basis: str  # where the number comes from: "cited: ...", "declared: ...", or "measured: machine, date"

    def __post_init__(self) -> None:
        if (self.source == "card") != (self.inference_s is not None):
            raise ValueError('inference_s goes with source = "card", and only with it')


@dataclass(frozen=True)
class Card:
    """One model on one engine."""

    name: str  # stem of its file, `<stem>:<engine>`, name of a directory or file, hub id, or `replay:<run>`
    engine: str
    description: str  # one line for people
    latency: Latency
    # Directory (absolute, or relative to the cards), GGUF file or hub id; the run's directory for `replay`;
    # the server's name of the model for `openai`; None without a model.
    weights: str | None = None
    file: str | None = None  # GGUF file in `weights`, unless `weights` is the file itself
    revision: str | None = None  # branch, tag or commit on the hub; None means its default branch
    sha256: Sha256 | None = None  # of the GGUF file or model.safetensors, checked on loading
    gated: bool = False  # whether the hub gives the weights only to those who have accepted their licence
    dtype: Dtype = "auto"  # number format of a checkpoint's weights; `auto` is the checkpoint's own
    quantisation: str | None = None  # number format of a GGUF file, for people only; the file decides
    context_tokens: Count | None = None  # most tokens of prompt and answer; None: the checkpoint's own limit
    thinking: Thinking = "none"  # `switch` if its template can turn it on and off, `always` if never off
    privileged: bool = False  # whether it sees behind the occlusion: an upper reference, never a contestant
    licence: str | None = None  # SPDX id of the weights' licence, or its name if it has no id
    max_new_tokens: Count | None = None  # of an answer, if the model needs another limit than its prompt's
    thinking_tokens: Count = 2048  # most tokens of a thought, in addition to the answer's, if asked to think
    server: Server | None = None  # the server of an `openai` model
    failures: Failures | None = None  # how often the proxy fails on purpose
    vision: Vision | None = None  # how the model takes pictures; None if it only reads text
    projector: str | None = None  # name of the GGUF file beside `file` that turns pictures into tokens
    # `first-user` puts the system text at the beginning of the first user turn, for a chat template that has
    # no place for it; None gives it a message of its own.
    system: System | None = None
    # `raw` for a model that was trained on one order of the letters; None, or `cyclic`, averages a read-out
    # over their orders, unless `--letters` says otherwise.
    letters: Letters | None = None

    @property
    def shown(self) -> str:
        return f"model {printable(self.name)!r}"

    def at(self, urls: tuple[str, ...]) -> "Card":
        """Return the card of a served model with other servers; the card itself if `urls` is empty.

        Raises ValueError if one is not a base URL, or is named twice.
        """
        return replace(self, server=replace(self.server, base_url=urls)) if self.server and urls else self

    def record(self) -> dict[str, Any]:
        """Return the card as plain values, from which `convert` makes it again."""
        record = asdict(self)
        del record["letters"]  # the agent's settings say how its letters are read
        if self.server:
            server = {key: value for key, value in record["server"].items() if value is not None}
            if self.server.fields:
                server["fields"] = dict(self.server.fields.changed)
            record["server"] = server
        return record
