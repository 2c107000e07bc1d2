"""results/made_with.py: a run says which code and which machine made it."""

import json
import sys

import torch

import results.made_with as made_with


def test_what_made_a_run_is_kept_once_and_added_to_when_it_changes(tmp_path, monkeypatch):
    assert not made_with.record(tmp_path, 7)  # train.py has not signed the folder yet
    (tmp_path / "run.owner").write_text("77 on a machine")
    assert not made_with.record(tmp_path, 7)  # another process has it
    assert not (tmp_path / "made_with.json").exists()
    for commit in ("a", "a", "b"):
        monkeypatch.setattr(made_with, "made_with", lambda commit=commit: {"commit": commit})
        assert made_with.record(tmp_path, 77)
    kept = json.loads((tmp_path / "made_with.json").read_text())
    assert kept == [{"commit": "a", "threads": 1}, {"commit": "b", "threads": 1}]


def test_it_names_commit_torch_python_and_processor(monkeypatch, tmp_path):
    monkeypatch.setattr(made_with.train, "has_bfloat16", lambda device: device.type == "cpu")
    found = made_with.made_with()
    assert found["torch"] == torch.__version__
    assert found["python"] == sys.version.split()[0] and found["processor"]
    assert found["bfloat16"] is True
    assert found["commit"] == "unknown" or len(found["commit"].removesuffix("-dirty")) == 40
    monkeypatch.setattr(made_with, "ROOT", tmp_path)  # no repository
    assert made_with.made_with()["commit"] == "unknown"
    monkeypatch.setenv("PATH", str(tmp_path))  # no git
    assert made_with.made_with()["commit"] == "unknown"
