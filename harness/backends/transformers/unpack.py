"""A GGUF file as a checkpoint that transformers loads: its weights as float32, made once and kept.

The file is read in Python and numpy. Its tokenizer is `harness.backends.tokens`' own,
which splits text as llama.cpp does.
"""

import io
import json
from contextlib import redirect_stderr
from pathlib import Path
from warnings import catch_warnings, simplefilter

from harness.backends.card import Card
from harness.backends.gguf import read_metadata, special_tokens
from harness.backends.registry import BUILT_IN
from harness.backends.tokens import tokenizer
from harness.backends.weights import sha256_weights
from harness.core import kept
from harness.core.errors import UserError, one_line, printable
from harness.core.files import digest, write_whole


def unpack_checkpoint(card: Card, file: Path) -> Path:
    """Return the folder of a float32 checkpoint with the weights of a GGUF file.

    It is made once and kept in the cache folder. `card` is the model card, which names the model in
    messages. Raises UserError if it cannot be made or written.
    """
    from transformers import __version__

    made_by = [__version__, BUILT_IN["transformers"].answers]
    to = kept.folder() / "checkpoints" / digest([sha256_weights(file), *made_by])[:16]
    subject = f"{card.shown} in {printable(file)}"
    try:
        kept.made(to, lambda part: _unpack(file, part, subject))
    except OSError as error:
        raise UserError(
            f"{subject}: its checkpoint cannot be written: {printable(error)}; it takes 4 bytes a "
            f"weight in {printable(to.parent)}; SWARMDRIVE_CACHE names another folder"
        ) from None
    return to


def _unpack(file: Path, to: Path, subject: str) -> None:
    import torch
    import transformers

    try:
        values = read_metadata(file, arrays=True)
    except ValueError as error:
        raise UserError(
            f"{subject} does not load: {error}; copy or download the file again"
        ) from None
    if not isinstance(values.get("tokenizer.chat_template"), str):
        raise UserError(
            f"{subject} has no chat template; give the GGUF file of its instruct version"
        )
    loaded = tokenizer(file)
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()
    try:
        # What is wrong is reported below; a bar of its own would stand in the middle of ours.
        with catch_warnings(), redirect_stderr(io.StringIO()):
            simplefilter("ignore")
            options = {"dtype": torch.float32, "local_files_only": True, "trust_remote_code": False}
            model, report = transformers.AutoModelForCausalLM.from_pretrained(
                file.parent, gguf_file=file.name, output_loading_info=True, **options
            )
    except Exception as error:  # a broken file surfaces as any of a dozen exception types
        # the disk, and not transformers' words
        if isinstance(error, OSError) and error.errno is not None:
            raise
        fault = f"{subject} does not load with transformers: {one_line(error)}"
        raise UserError(f"{fault}; run it on llama-cpp") from error
    if report["missing_keys"]:
        absent = sorted(report["missing_keys"])
        raise UserError(
            f"{subject} lacks {len(absent)} of its weights ({printable(absent[0])}); download the "
            "file again, or run it on llama-cpp"
        )
    model.hf_quantizer = None
    if hasattr(model.config, "quantization_config"):
        del model.config.quantization_config
    model.save_pretrained(to)
    loaded.save(str(to / "tokenizer.json"))
    settings = {
        "tokenizer_class": "PreTrainedTokenizerFast",
        "clean_up_tokenization_spaces": False,
        "chat_template": values["tokenizer.chat_template"],
        **special_tokens(values),
    }
    write_whole(to / "tokenizer_config.json", json.dumps(settings, indent=1))
