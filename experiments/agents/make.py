"""Train the agents that come with the code anew, each by one command, and put them into agents/.

python experiments/agents/make.py           all of them, one after another
python experiments/agents/make.py NAME ...  only these
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
KEPT = ("policy.pt", "config.yaml", "summary.json")
# The critics serve training alone; small ones keep policy.pt below 300 kB.
SMALL = "low.critic_hidden_dims=[64,64]"
AGENTS = {
    "linucb_hppo": ["high=linucb", "low=hppo", SMALL, "total_frames=4000000", "eval.every=500000"],
    "hppo_congruent": [
        *("high=none", "low=hppo", "env.controller=congruent", SMALL),
        *("total_frames=1000000", "eval.every=250000"),
    ],
}


def make(name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        words = [*AGENTS[name], f"hydra.run.dir={folder}", "overwrite=true"]
        subprocess.run([sys.executable, str(ROOT / "run.py"), *words], check=True)
        (ROOT / "agents" / name).mkdir(parents=True, exist_ok=True)
        for file in KEPT:
            shutil.copyfile(Path(folder) / file, ROOT / "agents" / name / file)


def main(names: list[str]) -> int:
    unknown = set(names) - set(AGENTS)
    if unknown:
        print(f"{', '.join(sorted(unknown))}: no such agent; there is {', '.join(AGENTS)}", file=sys.stderr)
        return 2
    for name in names or AGENTS:
        make(name)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
