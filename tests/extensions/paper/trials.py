"""How this extension's studies are tried."""

from studied import Trial

TRIALS = {
    "study": Trial(
        "study paper", "--episodes 10 --sweep-episodes 10", "--episodes 12 --sweep-episodes 10",
        "out holds another study, with other episodes_per_seed; name another folder",
        {
            "--episodes 9": "--episodes 9 is out of range; give 10 to",
            "--seeds 1,1": "--seeds 1,1: give different whole numbers, such as 0:5",
        },
        "It is no evidence that a language model would give them",
    ),
    "closed-loop": Trial(
        "study closed-loop --model proxy --workers 1 --pictures", "--episodes 1 --seeds 0",
        "--episodes 1 --seeds 0 --prompt v1", 
            "was begun with --prompt v2, "
            "and not with --prompt v1",
        {"--scenario nowhere": "nowhere", "--prompt v0": "v0"},
        "driven in closed loop on the layouts of",
    ),
}  # fmt: skip
