"""Runs whose every text is an attack, and the attacks:
each way into markup with each thing to do there.
"""

from run_on_disk import configure, made_up

from harness.coordination.named_points import POINTS
from harness.core.files import digest
from harness.runs.folder import read
from harness.runs.records import FrozenScenes, Latency, Score, Times
from harness.runs.writer import csv_text

WAYS_IN = (
    "{}", '">{}', "'>{}", "</td></tr></table>{}", "</title>{}", "</style>{}", "</script>{}", "</textarea>{}",
    "</pre>{}", "-->{}", "]]>{}", "</details></main>{}", '\\");{}', "</svg>{}", "</noscript>{}",
)  # fmt: skip
DEEDS = (
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "<svg onload=alert(1)>",
    "<iframe srcdoc='<script>alert(1)</script>'></iframe>",
    "<details open ontoggle=alert(1)>x</details>",
    "<a href=javascript:alert(1)>x</a>",
)
OTHERS = (
    '" onmouseover="alert(1)',
    "' onfocus='alert(1)' autofocus='",
    "javascript:alert(1)",
    "data:text/html,<script>alert(1)</script>",
    "{{constructor.constructor('alert(1)')()}}",
    "{{ 7 * 7 }}{% for x in y %}",
    "${alert(1)}",
    "`${alert(1)}`",
    "<scr<script>ipt>alert(1)</scr</script>ipt>",
    "<ScRiPt>alert(1)</sCrIpT>",
    "\u202e<script>alert(1)</script>\u202c",
    "<\x0cscript>alert(1)</script>",
    "<svg><animate onbegin=alert(1) attributeName=x dur=1s>",
    "<math><mtext><style><img src=x onerror=alert(1)>",
    "=cmd|'/c calc'!A0",
    "@SUM(1+1)*cmd|'/c calc'!A0",
    "+cmd|'/c calc'!A0",
    "-2+3+cmd|'/c calc'!A0",
    "&lt;img src=x onerror=alert(1)&gt;",
    "&#60;script&#62;alert(1)&#60;/script&#62;",
    "%3Cscript%3Ealert(1)%3C/script%3E",
    "\ud800<script>alert(1)</script>",
    "__proto__",
    "constructor",
    "datum['constructor']",
    "signal:alert(1)",
)
SPOKEN = (*(way.format(deed) for way in WAYS_IN for deed in DEEDS), *OTHERS)
# No file of a run can hold a lone surrogate: in an answer it is replaced before it is written.
PAYLOADS = tuple(text.encode("utf-8", "replace").decode() for text in SPOKEN)
# Each way with another deed than the one before it, and all that is written otherwise.
OF_EACH_KIND = (
    *(way * len(DEEDS) + way % len(DEEDS) for way in range(len(WAYS_IN))),
    *range(len(SPOKEN) - len(OTHERS), len(SPOKEN)),
)
VERDICTS = ("strict", "recovered", "failed")


class Attacker:
    """Says one payload after the other."""

    def __init__(self, start):
        self.turn = start

    def __call__(self):
        self.turn += 1
        return PAYLOADS[self.turn % len(PAYLOADS)]


def hostile(folder, dataset, n, conditions=PAYLOADS[:1]):
    """Make a run: its manifest says nothing but payload n,
    its answers and decisions say all in turn.
    """
    mine, said, dangers = PAYLOADS[n], Attacker(n), {}
    world = FrozenScenes(
        name=mine, sha256=dataset.sha256, nodes=3, episodes=3, limit=None, delay_allowance_s=1.0,
        decision_lag_s=0.145,
        path=str(dataset.path),
    )  # fmt: skip
    made_up(
        folder,
        decision=lambda row: _decision(row, dangers.setdefault(row["scene"], said())),
        episode=lambda row: row.update(danger=dangers.setdefault(row["episode"], said())),
        answer=lambda row: _answer(row, said, n),
        points=[POINTS["6g"].changed(name=name) for name in conditions],
        seeds=(0,),
        episodes=3,
        steps=1,
        name=mine,
        created=mine,
        command=mine,
        tags=[mine],
        model={"name": mine, "engine": mine, mine: mine},
        identity={mine: mine},
        prompt={"version": mine, "sha256": mine, "released": mine},
        world=world,
        dtype=mine,
        latency_source=mine,
        latency=Latency("card", mine, 0.1, 0.1, 0.1, {mine: Times(1, 0.1, 0.1, 0.1)}),
        versions={"harness": mine, mine: mine},
    )
    configure(folder, answer=mine)
    run = read(folder)
    scores = [*run.scores, Score("all", mine, 1.0, 1.0, 1.0, 4, 0, mine)]
    text = csv_text(Score, scores, run.manifest.variant)
    (folder / "summary.csv").write_text(text, encoding="utf-8")
    return folder


def prompt_of(n, scene, viewer):
    """What a viewer of run n was sent, an attack too."""
    episode, vehicle = int(scene.partition("-")[0]), int(viewer.removeprefix("v"))
    said = Attacker(n + 4 * (4 * episode + vehicle))
    return [{"role": said(), "content": said()} for _ in range(2)]


def _answer(row, said, n):
    """All but what is counted by: who answered, in which role, and how it was read."""
    row.update(
        raw=said(),
        error=said(),
        status=said(),
        verdict=VERDICTS[said.turn % 3],
        repairs=(said(), said()),
        detail=said(),
        intent=(0.2, 0.3, 0.5),
        mass=0.9,
        message={said(): said(), "evidence": said(), "risk": said()},
        prompt_tokens=300,
        completion_tokens=30,
        seconds=0.1,
        prompt_sha256=digest(prompt_of(n, row["scene"], row["viewer"])),
    )


def _decision(row, danger):
    """One reply in time, one lost, one late."""
    row.update(
        danger=danger, action="FASTER", entropy_nats=0.9, own_weight=0.4, latency_ms=150.0, value=True,
        safe=False, regret=True, delay_s=None, fused_SLOWER=0.1, fused_IDLE=0.2, fused_FASTER=0.7,
        safe_SLOWER=True, safe_IDLE=True, safe_FASTER=False, delay_s_SLOWER=0.0, delay_s_IDLE=0.0,
        delay_s_FASTER=None,
    )  # fmt: skip
    for k in range(3):
        sent = {"delivered": k != 1, "on_time": k == 0, "weight": 0.3}
        sent["arrival_ms"] = None if k == 1 else 160.0 + 60.0 * k
        row.update({f"{name}_{k + 1}": value for name, value in sent.items()})
