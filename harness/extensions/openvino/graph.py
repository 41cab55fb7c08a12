"""A GGUF file as OpenVINO's graph, which openvino-genai makes; made once, with its own weights.

openvino-genai reads the file while it opens a pipeline of its own, and writes the graph beside it.
It does so in another process: a damaged file may end that, and its pipeline's memory is freed.
"""

from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

from harness.backends.card import Card
from harness.backends.weights import check_digest, find_gguf, gguf_files, sha256_weights
from harness.core import kept
from harness.core.errors import UserError, one_line, printable
from harness.core.files import digest
from harness.extensions.openvino.registered import REGISTRATION

GRAPH = "exact.xml"  # with its weights beside it
_WRITTEN = "openvino_model.xml"  # by openvino-genai


def graph_of_card(card: Card) -> Path:
    """Return the file of the graph that OpenVINO runs, of the GGUF file that a model card names.

    It is made once and kept in the cache folder. Raises UserError if the file is not found, is not
    of the card's digest, or openvino-genai cannot read it.
    """
    file = check_digest(card, find_gguf(card))
    subject = f"{card.shown} in {printable(file)}"
    if len(gguf_files(file)) > 1:
        raise UserError(f"{subject} is split into several files; join them, or run it on llama-cpp")
    made_by = [version("openvino-genai"), REGISTRATION.answers]
    key = digest([sha256_weights(file), *made_by])
    to = kept.folder() / "openvino" / key[:16]
    try:
        kept.made(to, lambda part: _make(file, part, subject))
    except OSError as error:
        raise UserError(
            f"{subject}: its graph cannot be written: {printable(error)}; it is as large as the "
            f"file, in {printable(to.parent)}; SWARMDRIVE_CACHE names another folder"
        ) from None
    return to / GRAPH


def _make(file: Path, folder: Path, subject: str) -> None:
    folder.mkdir()
    link = folder / "model.gguf"
    link.symlink_to(file.resolve())
    try:
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            process.submit(write_graph, link).result()
        return
    except BrokenProcessPool:
        reason = "it ended the process that read it"
    except Exception as error:  # what it cannot read surfaces as any of a dozen exception types
        reason = one_line(error)
    fault = f"{subject} does not load with openvino-genai: {reason}"
    raise UserError(f"{fault}; run it on llama-cpp, or give another file")


def write_graph(file: Path) -> None:
    """Write the graph of a GGUF file beside it, and remove all else that openvino-genai writes.

    Raises ValueError if its weights are not read exactly.
    """
    import openvino as ov
    import openvino_genai

    from harness.extensions.openvino.exact import check_kinds, repair

    check_kinds(file)
    openvino_genai.LLMPipeline(str(file), "CPU", enable_save_ov_model=True)
    model = ov.Core().read_model(file.with_name(_WRITTEN))
    repair(model, file)
    graph = file.with_name(GRAPH)
    ov.save_model(model, graph, compress_to_fp16=False)
    del model  # which has the other file of weights open
    for path in file.parent.iterdir():
        if path.stem != graph.stem:
            path.unlink()
