"""Files are put in place whole, whoever else writes on the same disk."""

import os
import socket

import pytest

from giorom.data.atomic import replacing, replacing_folder
from giorom.data.work_log import remove_leftovers

HOSTS = ("gpu-node-0012.cluster.example", "gpu-node-0013.cluster.example")


def test_processes_of_one_number_on_two_hosts_do_not_share_a_temporary_file(tmp_path, monkeypatch):
    """Process numbers repeat between hosts; each writes its own file, and the last one stays."""
    monkeypatch.setattr(os, "getpid", lambda: 77)
    wanted = tmp_path / "value.txt"
    monkeypatch.setattr(socket, "gethostname", lambda: HOSTS[0])
    with replacing(wanted) as first:
        first.write_text("first")
        monkeypatch.setattr(socket, "gethostname", lambda: HOSTS[1])
        with replacing(wanted) as second:
            second.write_text("second")
        assert wanted.read_text() == "second"
    assert wanted.read_text() == "first"
    assert list(tmp_path.iterdir()) == [wanted]


def test_folders_of_one_process_number_on_two_hosts_are_apart(tmp_path, monkeypatch):
    """The second writer must not clear away what the first is filling."""
    monkeypatch.setattr(os, "getpid", lambda: 77)
    monkeypatch.setattr(socket, "gethostname", lambda: HOSTS[0])
    with replacing_folder(tmp_path / "set") as first:
        (first / "value").write_text("first")
        monkeypatch.setattr(socket, "gethostname", lambda: HOSTS[1])
        with replacing_folder(tmp_path / "set") as second:
            (second / "value").write_text("second")
    assert (tmp_path / "set" / "value").read_text() == "first"
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]


@pytest.mark.parametrize("host", [*HOSTS, "", "a/b c", "-", "x" * 80, "m\u00fcller"])
@pytest.mark.parametrize("name", ["00001.h5", "work.json", "plain"])
def test_what_a_killed_process_left_is_found_whatever_its_host(tmp_path, monkeypatch, host, name):
    """Temporary names and the pattern that clears them away agree; finished files stay."""
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    with replacing(tmp_path / name) as temporary:
        temporary.write_text("half")
        left, size = temporary.name, len(temporary.name)
    (tmp_path / left).write_text("half")
    remove_leftovers(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    assert size < len(name) + 40


def test_leftovers_of_earlier_versions_are_found_too(tmp_path):
    """Their temporary names carry the number of the process alone."""
    (tmp_path / ".00001.4711.tmp.h5").write_bytes(b"half")
    (tmp_path / ".hidden.h5").write_bytes(b"whole")
    remove_leftovers(tmp_path)
    assert [entry.name for entry in tmp_path.iterdir()] == [".hidden.h5"]
