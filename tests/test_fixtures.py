"""What stands about the arms: its distances against an exact collision library, and its place in a cell file."""

from __future__ import annotations

from pathlib import Path

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import CellFileError
from dualcal_hal.geometry import Block, CellGeometry, Cylinder, Fixture, HalfSpace, Mesh, Placement, read_mesh
from dualcal_hal.geometry.exact import ExactCell
from dualcal_hal.geometry.mesh import MOST_VOXELS
from dualcal_hal.transforms import apply, inverse, rotation_from_vector, smallest_rotation, transform
from procedures.planning.model import CellModel
from tests.cells import PAPER, paper_cell
from tests.reference_cell import NOMINAL_T_P_A

BOX_FACES = np.array(
    [
        [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
        [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
    ]
).reshape(-1, 3)


def box_triangles(sizes):
    """The surface (12, 3, 3) of a box about the origin."""
    return ((np.array(list(np.ndindex(2, 2, 2))) - 0.5) * sizes)[BOX_FACES]


def write_stl(path: Path, triangles) -> Path:
    corners = ["".join(f"vertex {x} {y} {z}\n" for x, y, z in t) for t in np.asarray(triangles).tolist()]
    facets = "".join(f"facet normal 0 0 0\nouter loop\n{c}endloop\nendfacet\n" for c in corners)
    path.write_text(f"solid s\n{facets}endsolid s\n")
    return path


TABLE = np.array([0.6, 0.4, 0.3])
SOLIDS = {
    "box": (Block(TABLE), coal.Box(TABLE)),
    "cylinder": (Cylinder(0.2, 0.5), coal.Cylinder(0.2, 0.5)),
    "plane": (HalfSpace(), coal.Halfspace(np.array([0.0, 0.0, 1.0]), 0.0)),
}
MESH = Mesh(box_triangles(TABLE))
MESH_ACCURACY = 0.023
T_BASE_SOLID = transform(rotation_from_vector([0.3, -0.5, 0.9]), [0.4, -0.2, 0.1])
segments = arrays(float, (2, 3), elements=st.floats(-1, 1).map(lambda x: round(x, 3)))


def exact_distance(shape, segment, radius=0.01):
    """From the axis of a capsule in the base to one of coal's shapes at T_BASE_SOLID."""
    along = segment[1] - segment[0]
    length = float(np.linalg.norm(along))
    R = smallest_rotation([0, 0, 1], along) if length > 0 else np.eye(3)
    capsule = coal.Capsule(radius, length), coal.Transform3s(R, segment.mean(axis=0))
    solid = shape, coal.Transform3s(T_BASE_SOLID[:3, :3], T_BASE_SOLID[:3, 3])
    return coal.distance(*capsule, *solid, coal.DistanceRequest(), coal.DistanceResult()) + radius


@pytest.mark.parametrize("kind", SOLIDS)
@settings(max_examples=200, deadline=None)
@given(segment=segments)
def test_the_distance_to_a_fixture_is_never_more_than_that_of_an_exact_library_and_hardly_less(kind, segment):
    solid, shape = SOLIDS[kind]
    distance = Fixture("it", solid, T_BASE_SOLID).separation(segment[None, None])[0, 0]
    exact = exact_distance(shape, segment)
    assert distance <= max(exact, 0.0) + 1e-5
    if exact > 0.05:
        assert distance >= exact - 0.001


@settings(max_examples=100, deadline=None)
@given(segment=segments)
def test_the_distance_to_a_mesh_is_never_more_than_the_true_one_and_less_by_23_mm_at_most(segment):
    distance = Fixture("it", MESH, T_BASE_SOLID).separation(segment[None, None])[0, 0]
    exact = exact_distance(coal.Box(TABLE), segment)
    assert distance <= max(exact, 0.0) + 1e-5
    assert distance >= min(exact, 1.0) - MESH_ACCURACY


@pytest.mark.parametrize("kind", [*SOLIDS, "mesh"])
@settings(max_examples=100, deadline=None)
@given(pair=arrays(float, (2, 2, 3), elements=st.floats(-1, 1)), enough=st.floats(0, 0.5), error=st.floats(0, 0.2))
def test_what_is_farther_than_enough_may_be_said_to_be_nearer_but_not_than_that(kind, pair, enough, error):
    fixture = Fixture("it", MESH if kind == "mesh" else SOLIDS[kind][0], T_BASE_SOLID)
    pair = pair + np.array([[0.0], [0.4], [0.8]])[..., None, None]
    told = fixture.separation_from_afar(np.eye(4), pair, error, error)
    quick = fixture.separation_from_afar(np.eye(4), pair, error, error, [enough, enough + 0.1])
    far = (quick >= [enough, enough + 0.1]) & (told >= [enough, enough + 0.1])
    assert np.all(far | (np.abs(quick - told) < 1e-3))


def test_a_tip_of_a_mesh_does_not_slip_between_the_points_of_a_segment():
    tip = Fixture("spike", Mesh(np.array([[[0.0, 0.0, 0.0], [0.001, 0.0, -0.3], [0.0, 0.001, -0.3]]])), np.eye(4))
    starts = np.linspace(-0.2, 0.0, 101)
    over_it = np.array([[[x, 0.0, 0.002], [x + 0.2, 0.0, 0.002]] for x in starts])
    assert np.max(tip.separation(over_it[None])) <= 0.002


def test_the_inside_of_a_mesh_is_part_of_it():
    middle = np.zeros((1, 1, 2, 3))
    assert Fixture("it", MESH, np.eye(4)).separation(middle)[0, 0] <= 0


def test_distances_to_a_mesh_of_any_size_take_no_more_memory():
    bench = Mesh(box_triangles([3.0, 2.0, 1.0]))
    assert bench._grid.distances.size < 1.3 * MOST_VOXELS
    above = np.array([[[[0.0, 0.0, 0.9], [1.0, 0.0, 0.9]]]])
    assert 0.34 < Fixture("bench", bench, np.eye(4)).separation(above)[0, 0] <= 0.4


directions = arrays(float, 3, elements=st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.1)


@pytest.mark.parametrize("kind", [*SOLIDS, "mesh"])
@settings(max_examples=100, deadline=None)
@given(
    segment=segments,
    along=directions,
    about=directions,
    error=st.tuples(st.floats(0, 0.2), st.floats(0, 0.4)),
    share=st.tuples(st.floats(0, 1), st.floats(0, 1)),
)
def test_the_distance_to_the_other_bases_fixture_holds_for_every_error(kind, segment, along, about, error, share):
    solid = MESH if kind == "mesh" else SOLIDS[kind][0]
    fixture = Fixture("it", solid, T_BASE_SOLID)
    at = fixture.separation_from_afar(np.eye(4), segment[None, None], *error)[0, 0]
    turn = about / np.linalg.norm(about) * error[1] * share[1]
    shift = along / np.linalg.norm(along) * error[0] * share[0]
    truly = apply(transform(rotation_from_vector(turn), shift), segment)
    shape = coal.Box(TABLE) if kind == "mesh" else SOLIDS[kind][1]
    assert at <= max(exact_distance(shape, truly), 0.0) + 1e-5


# In a cell

ALL_KINDS = """fixtures={
  table: {in: passive_base, box_mm: [400, 600, 40],
    at: {translation_mm: [450, 0, 450], rotation_vector_deg: [0, 0, 0]}},
  post: {in: active_base, cylinder_mm: {radius: 40, length: 900},
    at: {translation_mm: [250, 250, 450], rotation_vector_deg: [0, 0, 0]}},
  wall: {in: passive_base, plane: {}, at: {translation_mm: [-250, 0, 0], rotation_vector_deg: [0, 90, 0]}}}"""


def test_a_cell_keeps_clear_of_its_fixtures_as_of_their_true_shapes():
    cell, bare = paper_cell(ALL_KINDS).cell, paper_cell().cell
    capsules, exact = CellGeometry.of(cell), ExactCell.of(cell)
    rng = np.random.default_rng(5)
    q_a, q_p = rng.uniform(-1.5, 1.5, (2, 800, 6))
    placement = Placement(NOMINAL_T_P_A)
    clearance = capsules.clearance(q_a, q_p, placement)
    without = CellGeometry.of(bare).clearance(q_a, q_p, placement)
    assert np.all(clearance <= without + 1e-12)
    by_fixtures = (clearance > 0) & (clearance < without - 0.002)
    assert np.sum(by_fixtures) > 15
    truly = [exact.clearance(a, p, NOMINAL_T_P_A) for a, p in zip(q_a[by_fixtures], q_p[by_fixtures], strict=True)]
    assert np.min(truly - clearance[by_fixtures]) > -1e-5
    assert np.max(truly - clearance[by_fixtures]) < 0.03


@pytest.mark.parametrize("base", ["active_base", "passive_base"])
def test_the_same_fixture_is_as_far_in_whichever_base_it_is_given(base):
    bare = paper_cell().cell
    q_a, q_p = (0.0, -1.2, 0.8, 0.0, 0.0, 0.0), bare.passive.home
    beside_the_flange = NOMINAL_T_P_A @ bare.active.chain.forward(q_a)[:, 3] - [0.0, 0.16, 0.0, 0.0]
    T_P_solid = transform(np.eye(3), beside_the_flange[:3])
    T = T_P_solid if base == "passive_base" else inverse(NOMINAL_T_P_A) @ T_P_solid
    block = f"{{in: {base}, box_mm: [100, 200, 1000], at: {{matrix: {T.tolist()}}}}}"
    cell = paper_cell(f"fixtures={{block: {block}}}").cell
    clearance = CellGeometry.of(cell).clearance([q_a], [q_p], Placement(NOMINAL_T_P_A))[0]
    assert 0.0 < clearance <= 0.16 - 0.1 - 0.045
    assert clearance == pytest.approx(ExactCell.of(cell).clearance(q_a, q_p, NOMINAL_T_P_A), abs=0.001)


def test_an_arm_may_stand_on_a_fixture():
    standing = paper_cell(
        "fixtures={pedestal: {in: active_base, box_mm: [300, 300, 500], "
        "at: {translation_mm: [0, 0, -250], rotation_vector_deg: [0, 0, 0]}}}"
    ).cell
    q = [standing.active.home]
    assert CellGeometry.of(standing).active.own_clearance(q)[0] > 0.02


# In a cell file


def cell_with(tmp_path: Path, fixture: str) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(PAPER.read_text() + f"\nfixtures:\n  it: {{in: active_base, {fixture}}}\n")
    return path


AT = "at: {translation_mm: [500, 0, 100], rotation_vector_deg: [0, 0, 0]}"


@pytest.mark.parametrize("name", ["table.stl", "table.obj"])
def test_a_mesh_is_found_beside_the_cell_file_and_handed_on_by_its_absolute_path(tmp_path, name, monkeypatch):
    triangles = box_triangles(TABLE * 1000)
    if name.endswith("stl"):
        write_stl(tmp_path / name, triangles)
    else:
        corners = "".join(f"v {x} {y} {z}\n" for x, y, z in triangles.reshape(-1, 3).tolist())
        faces = "".join(f"f {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(len(triangles)))
        (tmp_path / name).write_text(corners + faces)
    path = cell_with(tmp_path, f"mesh: {{file: {name}}}, {AT}")
    monkeypatch.chdir(tmp_path.parent)
    file = load_cell(path.relative_to(tmp_path.parent))
    fixture = file.cell.fixtures["it"]
    assert fixture.mesh.file == str(tmp_path / name)
    assert file.text == path.read_text()
    np.testing.assert_allclose(np.ptp(fixture.solid.corners, axis=(0, 1)), TABLE, atol=1e-6)
    q = [file.cell.active.home]
    box = load_cell(cell_with(tmp_path, f"box_mm: [600, 400, 300], {AT}")).cell
    by_mesh, by_box = (CellGeometry.of(cell).active.own_clearance(q)[0] for cell in (file.cell, box))
    assert by_box - MESH_ACCURACY <= by_mesh <= by_box + 1e-6


def test_the_final_check_takes_a_mesh_as_it_is(tmp_path):
    write_stl(tmp_path / "table.stl", box_triangles(TABLE * 1000))
    by_mesh, by_box = (
        ExactCell.of(load_cell(cell_with(tmp_path, f"{shape}, {AT}")).cell)
        for shape in ("mesh: {file: table.stl}", "box_mm: [600, 400, 300]")
    )
    home = load_cell(PAPER).cell.passive.home
    for bend in (-0.2, -0.3, -0.4):
        q_a = (0.0, bend, 0.5, 0.0, 0.5, 0.0)
        expected = by_box.clearance(q_a, home, NOMINAL_T_P_A)
        assert expected < 0.02
        assert by_mesh.clearance(q_a, home, NOMINAL_T_P_A) == pytest.approx(expected, abs=1e-6)


def test_a_mesh_is_read_once_whatever_is_believed(tmp_path):
    write_stl(tmp_path / "table.stl", box_triangles(TABLE * 1000))
    cell = load_cell(cell_with(tmp_path, f"mesh: {{file: table.stl}}, {AT}")).cell
    model = CellModel(cell)
    here = model.home.active, model.home.passive, model.nominal.T_P_A
    expected = model.exact.clearance(*here)
    (tmp_path / "table.stl").unlink()
    later = model.believing(model.nominal.as_if_looked())
    assert later.exact.clearance(*here) == pytest.approx(expected, abs=1e-9)
    (fixture,), (again,) = (m.geometry.passive.fixtures or m.geometry.active.fixtures for m in (model, later))
    assert again.solid is fixture.solid


def test_the_unit_of_a_mesh_is_what_the_cell_file_says(tmp_path):
    stl = write_stl(tmp_path / "table.stl", box_triangles(TABLE))
    np.testing.assert_allclose(np.ptp(read_mesh(stl, 1.0), axis=(0, 1)), TABLE, atol=1e-6)
    np.testing.assert_allclose(np.ptp(read_mesh(stl, 0.0254), axis=(0, 1)), TABLE * 0.0254, atol=1e-6)


@pytest.mark.parametrize(
    ("fixture", "what"),
    [
        (f"mesh: {{file: gone.stl}}, {AT}", r":\d+:\d+: fixtures\.it\.mesh\.file: cannot be read: No such file"),
        (f"mesh: {{file: cell.yaml}}, {AT}", r"fixtures\.it\.mesh\.file: must be an STL or OBJ file"),
        (f"mesh: {{file: broken.stl}}, {AT}", r"fixtures\.it\.mesh\.file: holds no mesh"),
        (AT, r"fixtures\.it: must have exactly one of box_mm, cylinder_mm, plane, mesh"),
        (f"plane: {{}}, box_mm: [1, 1, 1], {AT}", "must have exactly one of"),
        (f"box_mm: [1, 1, 0], {AT}", r"fixtures\.it\.box_mm\.2: must be greater than 0"),
        ("plane: {}", r"fixtures\.it\.at: missing key"),
        (f"cylinder_mm: {{radius: 5, lenght: 3}}, {AT}", r"unknown key; did you mean 'length'"),
    ],
)
def test_what_is_wrong_with_a_fixture_is_said_with_its_place_in_the_file(tmp_path, fixture, what):
    (tmp_path / "broken.stl").write_text("solid of nothing")
    with pytest.raises(CellFileError, match=what) as refusal:
        load_cell(cell_with(tmp_path, fixture))
    line = len(PAPER.read_text().splitlines()) + 3
    assert f"cell.yaml:{line}:" in str(refusal.value)


def test_for_analysis_a_mesh_need_not_be_there(tmp_path):
    path = cell_with(tmp_path, f"mesh: {{file: gone.stl}}, {AT}")
    assert load_cell(path, meshes=False).cell.fixtures["it"].mesh is not None
