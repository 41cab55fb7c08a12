"""Templates that would fill memory or never end,
each rendered in a process of its own with all its steps.

    python benchmarks/campaigns/templates.py [--count 0] [--seed 0]

Those of `tests/hostile_templates.py`, as a prompt's and as a chat template of weights.
"""

import resource
import sys
import time
from multiprocessing import get_context
from typing import Any

from judging import TESTS, counted

from harness.backends.chat_template import ChatTemplate
from harness.core.errors import UserError
from harness.prompts.template import Template

sys.path.append(str(TESTS))  # behind this folder, which has a `judging` as well
from hostile_templates import PADDING, TEMPLATES

MOST_S, MOST_MB = 30, 1024


def as_prompt(text: str) -> None:
    Template(f"{{% block user %}}{text}{{% endblock %}}").render({"actions": ("A",)}, ("user",))


def as_chat(text: str) -> None:
    ChatTemplate("sly", text).render([{"role": "user", "content": "x"}])


KINDS = {"prompt": as_prompt, "chat": as_chat}


def rendered(kind: str, text: str, told: Any) -> None:
    """Render a template; tell how it ended, its CPU time and the memory of the process."""
    resource.setrlimit(resource.RLIMIT_CPU, (MOST_S, MOST_S))
    begun_s = time.process_time()
    try:
        KINDS[kind](text)
        how = "rendered"
    except (UserError, MemoryError) as error:
        how = "no memory" if isinstance(error, MemoryError) else "refused"
    except Exception:  # a prompt's error is put into words by its version
        how = "refused"
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    told.send((how, time.process_time() - begun_s, peak_mb))


def main() -> None:
    """Render each, and count how they ended."""
    counted(__doc__, 0)
    context = get_context("fork")
    ends: dict[str, int] = {}
    slowest_s = largest_mb = 0.0
    for kind in KINDS:
        for name, text in {**TEMPLATES, **PADDING}.items():
            ours, theirs = context.Pipe()
            process = context.Process(target=rendered, args=(kind, text, theirs))
            process.start()
            theirs.close()
            try:
                how, took_s, peak_mb = ours.recv()
            except EOFError:
                how, took_s, peak_mb = "never ended", float(MOST_S), 0.0
            process.join()
            ends[how] = ends.get(how, 0) + 1
            slowest_s, largest_mb = max(slowest_s, took_s), max(largest_mb, peak_mb)
            if how != "refused":
                print(f"{kind}, {name}: {how}")
    print(", ".join(f"{n} {how}" for how, n in ends.items()))
    print(f"at most {slowest_s:.1f} CPU s and {largest_mb:.0f} MB")
    raise SystemExit(set(ends) != {"refused"} or largest_mb > MOST_MB)


if __name__ == "__main__":
    main()
