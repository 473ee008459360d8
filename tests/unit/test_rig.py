"""The rig file: what is written is read, and what was edited is refused."""

import json

import numpy as np
import pytest

from binpick import rig as rig_file
from binpick.errors import RigError


@pytest.fixture
def path(tmp_path, rig):
    file = tmp_path / "rig.json"
    file.write_bytes(rig_file.dump(rig))
    return file


def changed(path, **changes):
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    return path


def test_what_is_written_is_read(path, rig):
    loaded, warnings = rig_file.load(path)
    assert loaded == rig
    assert loaded.sha256 == rig.sha256
    assert warnings == []


def test_an_edited_file_is_refused(path):
    with pytest.raises(RigError, match="sha256"):
        rig_file.load(changed(path, board="another"))


def test_a_hand_written_file_is_used_with_a_warning(path, rig):
    document = json.loads(path.read_text())
    del document["sha256"]
    path.write_text(json.dumps(document))
    loaded, warnings = rig_file.load(path)
    assert loaded == rig
    assert "hand-written" in warnings[0]


@pytest.mark.parametrize(("changes", "says"), [
    ({"format": "x"}, "binpick-rig"),
    ({"version": 2}, "version 2"),
    ({"cameras": []}, "cameras"),
    ({"T_base_rig": np.eye(4).tolist(), "T_flange_rig": np.eye(4).tolist()}, "not both"),
    ({"T_base_rig": (2 * np.eye(4)).tolist()}, "rigid"),
    ({"extra": 1}, "extra"),
])
def test_what_is_wrong_is_named(path, changes, says):
    document = json.loads(path.read_text()) | changes
    del document["sha256"]
    path.write_text(json.dumps(document))
    with pytest.raises(RigError, match=says):
        rig_file.load(path)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff\xfe"])
def test_what_is_no_json_is_named(path, content):
    path.write_bytes(content)
    with pytest.raises(RigError, match=r"rig\.json"):
        rig_file.load(path)
