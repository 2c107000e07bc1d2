"""What a run was made with, kept in its folder as made_with.json: a list of one entry, or of more
if a run that was stopped went on under other code or on another machine."""

import contextlib
import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
import train


def made_with() -> dict[str, object]:
    """The code, torch, Python and the processor of now; a commit ends in -dirty if files differ."""
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"]
    # the repository that is ours, not one around it; and no lock that a commit would wait for
    here = os.environ | {"GIT_CEILING_DIRECTORIES": str(ROOT.parent), "GIT_OPTIONAL_LOCKS": "0"}
    try:
        commit = subprocess.run(git, env=here, capture_output=True, text=True).stdout.strip()
    except OSError:  # there is no git
        commit = ""
    cpu = Path("/proc/cpuinfo").read_text() if sys.platform == "linux" else ""
    model = re.search(r"model name\s*: (.*)", cpu)
    return {
        "commit": commit or "unknown",
        "torch": torch.__version__,
        "python": platform.python_version(),
        "processor": model[1] if model else platform.processor() or platform.machine(),
        "bfloat16": train.has_bfloat16(torch.device("cpu")),  # which `--precision auto` takes then
    }


def record(folder: Path, pid: int) -> bool:
    """Add what is now to a run's made_with.json, if train.py of this process id has it by now:
    whether it has. Where it cannot be written the run goes on without."""
    owner, path = folder / "run.owner", folder / "made_with.json"
    with contextlib.suppress(OSError, ValueError):
        if not owner.exists() or not owner.read_text().startswith(f"{pid} on "):
            return False
        before = json.loads(path.read_text()) if path.exists() else []
        now = made_with() | {"threads": 1}  # reproduce.py gives each run one
        if now not in before:
            train.write_whole(path, (json.dumps([*before, now], indent=2) + "\n").encode())
    return True
