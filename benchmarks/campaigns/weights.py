"""A model whose weights are no numbers: every answer an error of the engine, in every mode,
on each engine.

    python benchmarks/campaigns/weights.py

The model is the tests' tiny Qwen3, its last norm NaN; `eval` asks it about one episode.
"""

import json
import struct
import sys
from pathlib import Path

from judging import TESTS, Tally, dataset, typed, workshop

from harness.backends.gguf_export import export

sys.path.append(str(TESTS))
import tiny_qwen3

MARK = 1234.5  # in place of NaN while a GGUF file is exported, which refuses it


def main() -> None:
    """Ask in every way."""
    tally = Tally()
    with workshop() as here:
        small = dataset(here / "small", 1)
        models = {
            "transformers": tiny_qwen3.build(here / "tiny", context_tokens=4096),
            "llama-cpp": gguf(here),
        }
        tiny_qwen3.spoil(models["transformers"])
        for engine, model in models.items():
            for mode in ("json", "constrained", "readout"):
                out = here / f"{engine}-{mode}"
                command = (
                    "eval",
                    "--model",
                    model,
                    "--answer",
                    mode,
                    "--dataset",
                    small,
                    "--seeds",
                    "0",
                )
                ended = typed(*command, "--condition", "6g", "--out", out)
                faults = ended.faults
                if not ended.code:
                    answers = [
                        json.loads(line)
                        for line in (out / "answers.jsonl").read_text().splitlines()
                    ]
                    said = [
                        answer for answer in answers if "no numbers" not in str(answer["error"])
                    ]
                    faults += (
                        [f"{len(said)} of {len(answers)} are no such error: {said[:1]}"]
                        if said
                        else []
                    )
                else:
                    faults.append(ended.err)
                tally.add(f"{engine}, {mode}", mode, faults)
        tally.end()


def gguf(here: Path) -> Path:
    """The same model as a GGUF file."""
    folder = tiny_qwen3.spoil(tiny_qwen3.build(here / "marked", context_tokens=4096), MARK)
    file = here / "tiny.gguf"
    export(folder, file, "F32")
    file.write_bytes(
        file.read_bytes().replace(struct.pack("<f", MARK), struct.pack("<f", float("nan")))
    )
    return file


if __name__ == "__main__":
    main()
