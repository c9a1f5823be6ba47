"""The stranger's test: the file in docs/extending.md, outside the package, through every command."""

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "extending.md").read_text()
RUN = "runs/mine"
FEWER = {
    "train": ["n_envs=16", "total_frames=20480", "compile=off", "evaluate=false", "checkpoint_seconds=0"],
    "evaluate": ["--episodes", "3", "--max-steps", "50"],
    "render": ["--steps", "20"],
    "verify": ["--frames", "4096"],
}


def shown():
    (block,) = re.findall(r"```bash\n(.*?)```", PAGE, flags=re.DOTALL)
    return [shlex.split(line) for line in block.splitlines()]


def words(command):
    """A shown command, with few frames and episodes, as it is run in another folder."""
    return [sys.executable, "-m", *command, *FEWER.get(command[1], [])]


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
def test_a_file_outside_the_package_trains_stops_resumes_and_goes_through_every_command(tmp_path):
    (code,) = re.findall(r'```python title="my_study.py"\n(.*?)```', PAGE, flags=re.DOTALL)
    (tmp_path / "my_study.py").write_text(code)
    train, *others = shown()
    assert "n_seeds=4" in train

    first = subprocess.Popen(words(train), cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    while first.poll() is None and not list((tmp_path / RUN).glob("checkpoint/state-*")):
        time.sleep(0.1)
    first.send_signal(signal.SIGINT)
    _, said = first.communicate(timeout=240)
    assert first.returncode == 130, said
    assert "saved at" in said
    assert said.count("\n") == 1

    for command in (train, *others):
        done = subprocess.run(words(command), cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, (command, done.stderr)
    assert (tmp_path / "episode.gif").exists()
    facts = json.loads((tmp_path / RUN / "meta.json").read_text())
    assert list(facts["plugins"]) == ["my_study"]
    assert len(facts["plugins"]["my_study"]) == 64
    rows = pd.read_parquet(tmp_path / RUN / "evaluation-test-3-50.parquet")
    assert sorted(rows["seed"].unique()) == [0, 1, 2, 3]
    assert "REINFORCE" in (tmp_path / "runs" / "report.md").read_text().upper()

    evaluate = next(command for command in others if command[1] == "evaluate")
    without = [word for word in words(evaluate) if word not in ("--plugins", "my_study")]
    refused = subprocess.run(without, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert "--plugins my_study" in refused.stderr
