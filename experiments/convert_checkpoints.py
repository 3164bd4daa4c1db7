"""Convert saved agents of version 0.3 to the files of this version. The old files stay.

python experiments/convert_checkpoints.py FOLDER     checkpoint.zip, policy.pt and best.pt in the folder of a run
python experiments/convert_checkpoints.py FILE ...   files, such as one that `Agent.save` wrote
"""

import io
import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import torch

from hpamdp.messages import exit_code
from hpamdp.run import checkpoint, state_file
from hpamdp.run_files import OLD_NAMES

OLD_FORMAT = 2


def contents(file: Path) -> dict[str, Any]:
    """Return the parts of a saved agent and the progress of its run."""
    with zipfile.ZipFile(file) as archive:
        if "manifest.json" not in archive.namelist():
            saved = torch.load(file, weights_only=True)
            return {**saved, "progress": json.loads(saved["progress"])}
        manifest = json.loads(archive.read("manifest.json"))
        saved = {"format": manifest["format"], "progress": manifest["progress"]}
        for name in manifest["members"]:
            saved[name] = torch.load(io.BytesIO(archive.read(f"{name}.pt")), weights_only=True)
        return saved


def convert(file: Path) -> Path:
    """Write a saved agent beside its file in today's form, and return the new file."""
    saved = contents(file)
    if saved["format"] != OLD_FORMAT:
        raise SystemExit(f"{file}: not a file of version 0.3")
    for part in saved.values():
        if isinstance(part, dict) and "writer" in part:  # of a replay buffer
            part["write_count"] = part.pop("writer")["_write_count"]
            del part["num_rows"]
    # Selectors have `practice` in its place.
    agent = {name: value for name, value in saved["agent"].items() if not name.endswith(".is_uniform")}
    target = file.with_suffix(".safetensors")
    state_file.write(target, {**saved, "format": checkpoint.FORMAT, "agent": agent})
    return target


def main(words: list[str]) -> int:
    """Convert the given files and the files in the given folders."""
    paths = [Path(word) for word in words]
    if not paths or not all(path.exists() for path in paths):
        print(__doc__, file=sys.stderr)
        return 2
    for path in paths:
        files = [path / name for name in OLD_NAMES if (path / name).is_file()] if path.is_dir() else [path]
        for file in files:
            print(convert(file))
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
