"""The cell file: only a bin is required; an error names file, line, key and what is allowed."""

import numpy as np
import pytest

from binpick import settings
from binpick.errors import SettingsError, UnknownItem

BIN = "bin:\n  inner_size_m: [0.6, 0.4, 0.18]\n  pose: {position_m: [0, 0, 1]}\n"


def test_only_a_bin_is_required():
    cell = settings.parse(BIN, "cell.yaml")
    assert cell.control == "modbus"
    job = settings.resolve(cell)
    assert (job.bin.number, job.tool.number, job.recipe.number) == (1, 1, 1)


@pytest.mark.parametrize(("text", "says"), [
    ("", "mapping"),
    ("bin: [", "not YAML"),
    ("bin: {}\n", "inner_size_m"),
    (BIN + "colour: red\n", "cell.yaml:4: colour: unknown key"),
    (BIN + "timeout_ms: 5\n", "cell.yaml:4: timeout_ms: .*100.*it is 5"),
    (BIN + "recipes:\n  - number: 1\n    exposure_us: -4\n", "cell.yaml:6: recipes.0.exposure_us"),
    (BIN + "recipes:\n  - {number: 1, bin: 7}\n", "no bin 7"),
    (BIN + "recipes:\n  - {number: 1, tools: [9]}\n", "no tool"),
    (BIN + "recipes: [{number: 2}, {number: 2}]\n", "stand once"),
    (BIN + "bins: []\n", "not both"),
    (BIN + "cameras: {left: {address: 1.2.3.4}}\n", "backend"),
    (BIN + "publish: {modbus: null}\n", "control is modbus"),
    (BIN + "cameras: {backend: aravis, left: {}}\n", "cameras.left: .*address"),
    (BIN + "cameras: {backend: files, left: l.png, right: r.png, max_skew_us: 5}\n", "max_skew_us: unknown key"),
    (BIN + "recipes: [{tools: [1, 1]}]\n", "recipes.0: .*tools: every number may stand once"),
    (BIN + "gripper: {kind: hook}\n", "tools.0: a tool's kind is suction or two_finger"),
    (BIN + "gripper: {kind: two_finger, cups: [{}]}\n", "tools.0.cups: unknown key"),
    (BIN + "gripper: {kind: two_finger, fingers: {stroke_min_m: 0.2}}\n", "tools.0.fingers: .*stroke_min_m must be below"),
    (BIN + "gripper: {kind: two_finger, fingers: {pad_depth_m: 0.1}}\n", "pad_depth_m must not be above length_m"),
    (BIN + "recipes: [{limits: {reach: {min_m: [0, 0, 0], max_m: [1, 1, -1]}}}]\n", "min_m must be below max_m"),
    (BIN + "recipes: [{shots: []}]\n", "recipes.0.shots: .*at least 1"),
    (BIN + "recipes: [{shots: [{exposure_us: 5}]}]\n", "recipes.0.shots.0.exposure_us: .*20"),
    (BIN + "recipes: [{shots: [{pattern: 50}]}]\n", "recipes.0.shots.0.pattern"),
    (BIN + "recipes: [{shots: [{pattern: 8}, {pattern: 9}]}]\n", "the Gray code is the patterns 8 to 49, each once"),
    (BIN + "recipes: [{shots: [{projector: false}, {}]}]\n", "the first must have the projector on"),
    (BIN + "recipes: [{projector: false, shots: [{pattern: 1}]}]\n", "a pattern needs the projector"),
    (BIN + "cameras: {backend: files, left: l.png, right: r.png}\nrecipes: [{shots: [{}, {}]}]\n", "are one shot, not 2"),
    (BIN + "recipes: [{exposure_us: often}]\n", "recipes.0.exposure_us"),
    (BIN + "recipes: [{projector: sometimes}]\n", "recipes.0.projector"),
    (BIN + "recipes: [{exposure_us: auto, hdr: 4, shots: [{pattern: 1}]}]\n", "exposure_us: auto and hdr: not with numbered"),
    (BIN + "recipes: [{exposure_us: auto, gain_db: 9}]\n", "gain_db 9 is above auto.highest_gain_db 6"),
    (BIN + "recipes: [{exposure_us: auto, shots: [{gain_db: 2}]}]\n", "needs its own exposure_us"),
    (BIN + "cameras: {backend: files, left: l.png, right: r.png}\nrecipes: [{hdr: 4}]\n", "are one shot, not 2"),
    (BIN + "cameras: {backend: files, left: l.png, right: r.png}\nrecipes: [{exposure_us: auto}]\n", "needs cameras"),
    (BIN + "gripper: {cups: [{x_m: 0.01}]}\n", "the TCP must be the middle of the cups"),
    (BIN + "gripper: {wrist: {turns: 2}}\n", "turns: unknown key"),
    (BIN.replace("[0, 0, 1]", "[0, 0, 1], rotvec_rad: [0, 0, 0], kuka_abc_deg: [0, 0, 0]"), "exactly one orientation"),
    (BIN.replace("[0, 0, 1]", "[0, 0, .nan]"), "finite"),
])
def test_an_error_says_where_and_what(text, says):
    with pytest.raises(SettingsError, match=says):
        settings.parse(text, "cell.yaml")


@pytest.mark.parametrize(("recipe", "expected"), [
    ("{exposure_us: 5000, hdr: 4}", [(5000, True, False), (1250, True, False)]),
    ("{exposure_us: 5000, projector: alternate}", [(5000, True, False), (5000, False, False)]),
    ("{exposure_us: 5000, projector: alternate, shots: [{}, {projector: false, exposure_us: 900}]}",
     [(5000, True, False), (900, False, False)]),
    ("{projector: alternate, hdr: 2}", [(6000, True, False), (3000, True, False), (6000, False, False), (3000, False, False)]),
    ("{exposure_us: 30, hdr: 30}", [(30, True, False), (20, True, False)]),
    ("{exposure_us: auto, hdr: 3, shots: [{}, {exposure_us: 900}]}",
     [(6000, True, True), (2000, True, True), (900, True, False), (300, True, False)])])
def test_one_setting_makes_several_shots(recipe, expected):
    taken = settings.resolve(settings.parse(BIN + f"recipes: [{recipe}]", "cell.yaml")).recipe
    assert [(light.exposure_us, light.projector, light.metered) for light in taken.lights] == expected
    assert [light.exposure_us for light in taken.single.lights] == [expected[0][0]]


def test_a_shot_is_exposed_as_the_recipe_says_unless_it_says_otherwise():
    shots = "[{}, {exposure_us: 900}, {projector: false}, {gain_db: 0, pattern: 2}]"
    text = f"recipes: [{{exposure_us: 5000, gain_db: 3, shots: {shots}}}]"
    lights = settings.resolve(settings.parse(BIN + text, "cell.yaml")).recipe.lights
    assert [(light.exposure_us, light.gain_db, light.projector, light.pattern) for light in lights] == [
        (5000.0, 3.0, True, 0), (900.0, 3.0, True, 0), (5000.0, 3.0, False, 0), (5000.0, 0.0, True, 2)]


def test_a_gray_code_recipe_lists_the_whole_sequence():
    shots = [{"pattern": pattern} for pattern in range(8, 50)]
    cell = settings.parse(BIN + f"recipes: [{{shots: {shots}}}]", "cell.yaml")
    assert [light.pattern for light in cell.recipes[0].lights] == list(range(8, 50))


def test_without_shots_a_recipe_is_one_shot_of_its_own_light():
    (light,) = settings.resolve(settings.parse(BIN + "recipes: [{exposure_us: 5000, projector: false}]", "c")).recipe.lights
    assert (light.exposure_us, light.gain_db, light.projector, light.pattern) == (5000.0, 0.0, False, 0)


def test_an_error_in_a_list_is_reported_once():
    with pytest.raises(SettingsError) as caught:
        settings.parse(BIN + "recipes:\n  - number: 1\n    exposure_us: -4\n", "cell.yaml")
    assert "too_short" not in str(caught.value)
    assert "at least 1 item" not in str(caught.value)


def test_relative_paths_start_at_the_cell_file(tmp_path):
    file = tmp_path / "cell.yaml"
    file.write_text(BIN + "cameras: {backend: files, left: l.png, right: /r.png}\n")
    cell = settings.load(file)
    assert cell.rig == tmp_path / "rig.json"
    assert cell.cameras.left == tmp_path / "l.png"
    assert str(cell.cameras.right) == "/r.png"


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SettingsError, match="nowhere"):
        settings.load(tmp_path / "nowhere.yaml")


def test_requests_choose_by_number():
    cell = settings.parse(BIN + "recipes: [{number: 5}, {number: 6, name: second}]\n", "cell.yaml")
    assert settings.resolve(cell).recipe.number == 5
    assert settings.resolve(cell, recipe=6).recipe.name == "second"
    for wrong in ({"recipe": 7}, {"bin_number": 2}, {"tool": 3}):
        with pytest.raises(UnknownItem, match="the cell file has"):
            settings.resolve(cell, **wrong)


def test_a_recipe_may_pick_with_several_tools_and_a_request_with_one():
    cell = settings.parse(BIN + "tools: [{number: 1}, {number: 7, kind: two_finger}]\nrecipes: [{tools: [7, 1]}]\n", "c")
    assert [tool.kind for tool in settings.resolve(cell).tools] == ["two_finger", "suction"]
    assert [tool.number for tool in settings.resolve(cell, tool=1).tools] == [1]
    assert settings.resolve(cell).tool_numbered(7).kind == "two_finger"
    assert settings.Job.model_validate_json(settings.resolve(cell).model_dump_json()) == settings.resolve(cell)


def test_settings_are_named_by_their_content():
    a, b = (settings.resolve(settings.parse(BIN + extra, "x")) for extra in ("", "recipes: [{number: 1, exposure_us: 900}]\n"))
    assert a.sha256 != b.sha256
    assert a.recipe_sha256 != b.recipe_sha256


@pytest.mark.parametrize("text", ["quaternion_xyzw: [0, 0, 0.7071068, 0.7071068]", "rotvec_rad: [0, 0, 1.5707963]",
                                  "kuka_abc_deg: [90, 0, 0]", "fanuc_wpr_deg: [0, 0, 90]", "ur_rxryrz_rad: [0, 0, 1.5707963]"])
def test_every_way_to_write_an_orientation(text):
    cell = settings.parse(BIN.replace("[0, 0, 1]", f"[0, 0, 1], {text}"), "cell.yaml")
    expected = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]])
    assert np.allclose(cell.bins[0].T_parent_bin, expected, atol=1e-6)


MESH = """
bin: {inner_size_m: [0.3, 0.2, 0.1], pose: {position_m: [0, 0, 1]}}
tools: [{number: 1}, {number: 2}]
recipes: [{mesh: {file: parts/a.stl, unit: mm, grasps: [GRASP]}}]
"""


def test_a_mesh_lies_beside_the_cell_file(tmp_path):
    (tmp_path / "cell.yaml").write_text(MESH.replace("GRASP", "{tool: 1, T_part_tcp: {}}"))
    mesh = settings.load(tmp_path / "cell.yaml").recipes[0].mesh
    assert mesh is not None
    assert mesh.file == tmp_path / "parts/a.stl"


@pytest.mark.parametrize(("grasp", "says"), [
    ("{tool: 2, T_part_tcp: {}}", r"recipe 1: mesh.grasps are for tool \[2\], the recipe's are \[1\]"),
    ("{tool: 1, T_part_tcp: {}, open_m: 0.01, close_m: 0.02}", "close_m must not be above open_m"),
])
def test_a_taught_grasp_is_one_that_the_recipe_can_do(grasp, says):
    with pytest.raises(SettingsError, match=says):
        settings.parse(MESH.replace("GRASP", grasp), "cell.yaml")
