"""Logs of other programs that `harness compare` pairs."""

from pathlib import Path

from harness.report.compare.logs import ComparedLogs


class InspectLogs:
    """Read and compare two logs of Inspect AI, `.eval` files."""

    suffix = ".eval"

    def compare(self, a: Path, b: Path) -> ComparedLogs:
        from harness.extensions.interop import inspect_samples, sample_pairs

        return sample_pairs.pair(inspect_samples.read(a), inspect_samples.read(b))


class LmEvalAnswers:
    """Read and compare two files of answers of lm-evaluation-harness, `samples_*.jsonl`."""

    suffix = ".jsonl"

    def compare(self, a: Path, b: Path) -> ComparedLogs:
        from harness.extensions.interop import lm_eval_samples, sample_pairs

        return sample_pairs.pair(lm_eval_samples.read(a), lm_eval_samples.read(b))


INSPECT = InspectLogs()
LM_EVAL = LmEvalAnswers()
