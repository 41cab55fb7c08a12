"""How this extension's study is tried."""

from studied import Trial

TUNE = "--tune data --limit 2"
TRIALS = {
    "optimize": Trial(
        "prompt optimize --model "
        "swarm-tiny --prompt mine "
        "--no-cache", f"{TUNE} --budget 300 --workers 1",
        f"{TUNE} --budget 200 --workers 1", "--out new: a prompt of that name is there already",
        {
            f"{TUNE} --budget 9 --out new --model proxy": "reads the scene and no prompt",
            f"{TUNE} --budget 9 --out new --prompt v3": "no alternatives are marked",
            f"{TUNE} --budget 9 --out new --first-seed 100000": "searched on tune seeds",
            f"{TUNE} --budget 9 --out new --first-seed 200000": "searched on tune seeds",
            "--budget 9 --out new --tune occluded-intersection-v2": "searched on tune seeds",
            f"{TUNE} --budget 9 --out new --dataset data": "certified on report seeds",
            f"{TUNE} --budget 9 --out new --condition 6g --condition v2x": "give one",
            f"{TUNE} --budget 0 --out new": "1 or more",
            f"{TUNE} --budget 9 --out v3": "there already",
            f"{TUNE} --budget 9 --out ../x": "cannot name a prompt",
            f"{TUNE} --budget 9 --out new --latency measured": "give seconds",
        },
        "read once, after the search", out="--out new", folder="reports/new",
        beside=[f"prompts/new/{name}" for name in ("ego.j2", "helper.j2", "history.json", "prompt.toml")],
        dry=True, ends=False,
    ),
}  # fmt: skip
