"""Many fits: records become rows, whatever happens to files, workers and the process that asks."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from chosen import first
from folders import in_trimesh, put
from numpy.testing import assert_allclose, assert_array_equal
from oracles import drawn, lump, normal, turned, usual_camera
from PIL import Image
from processes import printed, python
from refusals import pairs, refusal, refuses
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import __main__ as command, batch, formats, io
from pinhole_jax.batch import parts
from pinhole_jax.batch.parts import Writer
from pinhole_jax.batch.records import digest_of
from pinhole_jax.batch.rows import empty_row, line_of, row_of
from pinhole_jax.show.page import ENDINGS

SIZE = 64
COUNT = 4


@pytest.fixture(scope="module")
def truths():
    """Cameras about a shape of radius 100."""
    places = normal((COUNT, 3))
    places *= 520 / np.linalg.norm(places, axis=1, keepdims=True)
    return [pj.Camera(e, [0, 0, 0], [0.1, 1, 0.2], 0.6, 1.0, SIZE, SIZE) for e in places]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, truths):
    """A data set as BOP's lie on disk: one object, `COUNT` pictures in two scenes."""
    folder, shape = tmp_path_factory.mktemp("batch"), pj.shapes.bumpy(2)
    mesh = pj.Mesh(100 * np.asarray(shape.vertices), shape.faces)
    (folder / "models").mkdir()
    in_trimesh(mesh).export(folder / "models" / "obj_000007.ply")
    for begin in (0, 2):
        place = folder / "test" / f"{begin + 1:06d}"
        (place / "mask_visib").mkdir(parents=True)
        cameras, objects = {}, {}
        for k, camera in enumerate(truths[begin : begin + 2]):
            image = drawn(camera, pj.Scene(mesh)) > 0.5
            io.save_image(place / "mask_visib" / f"{k:06d}_000000.png", image)
            K, R, t = (x.ravel().tolist() for x in in_opencv(camera))
            cameras[k] = {"cam_K": K, "depth_scale": 1.0}
            objects[k] = [{"cam_R_m2c": R, "cam_t_m2c": t, "obj_id": 7}]
        (place / "scene_camera.json").write_text(json.dumps(cameras))
        (place / "scene_gt.json").write_text(json.dumps(objects))
    return folder


def in_opencv(camera):
    return formats.to_opencv(camera, pixel_centres="integer")


@pytest.fixture(scope="module")
def records(folder):
    return list(batch.read_dataset(folder / "test", start=True))


@pytest.fixture(scope="module")
def rows(records):
    return [batch.fit_one(record) for record in records]


def check_pose(row, truth):
    """Assert that a row's pose is as near as a hard mask of 64 px tells."""
    _, R, t = in_opencv(truth)
    turn = Rotation.from_matrix(np.reshape(row["R"], (3, 3)).T @ R)
    assert np.rad2deg(turn.magnitude()) < 2
    assert np.linalg.norm(np.array(row["t"]) - t) < 0.05 * np.linalg.norm(t)


def failed(id, words=""):
    """The row of a record that could not be fitted."""
    return empty_row({"id": id}, "failed", words)


def write_rows(folder, rows):
    """Write rows as a run does; return the results in the folder."""
    writer = Writer(folder)
    for row in rows:
        writer.add(row)
    writer.flush()
    return batch.Results(folder)


def timeless(rows):
    """Rows as lines, without what the clock says."""
    return [line_of({**row, "seconds": 0.0}) for row in rows]


# One record.


def test_row_has_the_camera_of_the_mask(records, rows, truths):
    for row, record, truth in zip(rows, records, truths, strict=True):
        assert list(row) == list(batch.COLUMNS)
        assert row["status"] == "converged", row["words"]
        check_pose(row, truth)
        assert_allclose(row["K"], in_opencv(truth)[0].ravel(), atol=1e-9)
        assert json.loads(row["record"]) == record
        assert row["hash"] == digest_of(record)
        assert row["seconds"] > 0
        fit = batch.fit_of(row)
        assert (fit.status, list(fit.names)) == (row["status"], row["names"])
        assert_array_equal(fit.covariance.ravel(), row["covariance"])


def test_run_lengths_are_as_good_as_a_picture(records, rows):
    from pycocotools import mask as coco

    inside = io.load_mask(records[0]["mask"]) > 127
    rle = coco.encode(np.asfortranarray(inside.astype(np.uint8)))
    steps = np.flatnonzero(np.diff(np.pad(inside.T.ravel(), (1, 0))))
    plain, size = np.diff([0, *steps, inside.size]).tolist(), rle["size"]
    for counts in (rle["counts"], rle["counts"].decode(), plain, tuple(plain), np.array(plain)):
        for shape in (size, tuple(size), np.array(size)):
            assert_array_equal(io.mask_of_rle({"size": shape, "counts": counts}), 255 * inside)
    outside = {"size": size, "counts": [0, *plain]}
    row = batch.fit_one({**records[0], "mask": outside, "invert": True})
    assert (row["R"], row["status"]) == (rows[0]["R"], rows[0]["status"])


#: Values of fields that no row can be made of, by the argument that is named.
BAD = {
    "mask": ["missing.png", "short.png", ".", {"size": [2, 2], "counts": [3]}],
    "mesh": ["missing.ply", "short.png", "points.obj", "."],
    "weight": ["small.png", "missing.png"],
    "photo": ["small.png"],
    "K": [[1, 2], "a b c d", [-60, -60, 32, 32]],
    "start": [[1.0], np.ones((4, 4)).tolist()],
    "dist": [[0.1]],
    "free": ["zoom"],
    "mask_from": ["a guess"],
    "pixel_centres": ["somewhere"],
    "max_steps": [0],
    "fov": [30.0],
    "invert": ["False"],
    "prior": [{"zoom": [1, 1]}],
}
BAD_ITEMS = [(name, {name: value}) for name, values in BAD.items() for value in values]
BAD_ITEMS += [("item", x) for x in ({"colour": "red"}, {"mask": None}, {"max_steps": np.nan})]


def test_bad_items_are_rows_that_name_what_is_wrong(records, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Image.new("L", (SIZE, SIZE)).save("empty.png")
    Image.new("L", (3, 3)).save("small.png")
    Path("short.png").write_bytes(Path("empty.png").read_bytes()[:60])
    Path("points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    for name, change in [*BAD_ITEMS, ("target", {"mask": "empty.png"})]:
        row = batch.fit_one({**records[0], **change, "id": "bad"})
        assert row["status"] == "failed", change
        assert f"`{name}`" in row["words"], (change, row["words"])
        assert row_of(line_of(row)) == row


def test_record_without_id_is_refused():
    for record, words in (({"mesh": "a"}, "`id`.*None"), ({"id": ""}, "`id`.*''")):
        for fit in (batch.fit_one, lambda record: batch.fit_many([record])):
            with refusal(words):
                fit(record)


def test_digest_follows_file_contents(tmp_path):
    mask = tmp_path / "mask.png"
    mask.write_bytes(b"one")
    record = {"id": "a", "mesh": "none", "mask": str(mask)}
    first = digest_of(record)
    assert digest_of({**record, "id": "b"}) == first
    mask.write_bytes(b"two")
    assert digest_of(record) != first


# Rows on disk.


def test_json_line_keeps_infinities_and_nan():
    row = empty_row({"id": "a"}, "rank_deficient", "") | {
        "std": [0.5, np.inf, -np.inf, np.nan],
        "iou": np.nan,
    }
    read = row_of(line_of(row))
    assert read["std"][:3] == row["std"][:3]
    assert np.isnan(read["std"][3])
    assert np.isnan(read["iou"])
    json.loads(line_of(row), parse_constant=pytest.fail)


def test_rows_are_whole_and_each_counts_once(tmp_path):
    writer = Writer(tmp_path)
    for id in ("b", "a"):
        writer.add(failed(id, "first"))
    assert list(batch.Results(tmp_path)) == []
    writer.flush()
    results = write_rows(tmp_path, [empty_row({"id": "a"}, "crashed", "second")])
    assert [(row["id"], row["words"]) for row in results] == [("a", "second"), ("b", "first")]
    assert results.ids() == {"a", "b"}
    assert results.counts() == {"crashed": 1, "failed": 1}
    assert [row["id"] for row in results.rows("ba")] == ["b", "a"]
    with refusal(r"`id`.*'c'"):
        results.row("c")


def test_rows_reach_the_disk_some_seconds_apart(tmp_path, monkeypatch):
    writer = Writer(tmp_path)
    writer.add(failed("a"))
    assert not batch.Results(tmp_path).ids()
    monkeypatch.setattr(parts, "SECONDS", 0.0)
    writer.add(failed("b"))
    assert batch.Results(tmp_path).ids() == {"a", "b"}


def test_folder_of_other_files_is_refused(tmp_path):
    (tmp_path / "part-1.jsonl").write_text("{}\n")
    with refusal(r"`out`.*part-1\.jsonl"):
        batch.Results(tmp_path).ids()
    with refusal(r"`out`.*a file"):
        batch.Results(tmp_path / "part-1.jsonl")


def test_shards_part_the_records():
    ids = [f"scene/{k}" for k in range(1000)]
    count = np.bincount([batch.shard_of(id, 7) for id in ids], minlength=7)
    assert count.sum() == 1000
    assert count.min() > 100
    assert 0 <= batch.shard_of("\udcfc.png", 7) < 7  # a file's name need be no text
    assert batch.shard_of("a", 1000) == 250  # on any machine, in any version


def test_table_has_all_rows(rows, tmp_path):
    results = write_rows(tmp_path, [*rows[::-1], failed("z", "words")])
    path = tmp_path / "table.jsonl"
    assert batch.merge(results, path) == COUNT + 1
    read = [row_of(line) for line in path.read_text().splitlines()]
    assert [row["id"] for row in read] == [*sorted(row["id"] for row in rows), "z"]
    assert timeless(read) == timeless(results)
    with refusal(r"`path`.*\.jsonl or \.csv"):
        batch.merge(results, tmp_path / "table.txt")


def read_csv(path):
    with open(path, newline="") as stream:
        return list(csv.DictReader(stream))


def test_bop_results(rows, truths, tmp_path):
    results = write_rows(tmp_path, [*rows, failed("test/1/2/3/4")])
    assert batch.merge(results, tmp_path / "bop.csv") == COUNT
    lines = read_csv(tmp_path / "bop.csv")
    assert list(lines[0]) == ["scene_id", "im_id", "obj_id", "score", "R", "t", "time"]
    for line, row, truth in zip(lines, rows, truths, strict=True):
        assert (line["obj_id"], float(line["score"])) == ("7", row["iou"])
        check_pose({name: np.array(line[name].split(), float) for name in "Rt"}, truth)
        assert float(line["time"]) == pytest.approx(row["seconds"], abs=1e-6)


def test_flat_table_has_a_line_for_every_row(rows, tmp_path):
    found = [row | {"id": id} for id, row in zip(("first, of two", "second"), rows, strict=False)]
    lost = failed("test/1/2/3/4", 'no "mask"')
    assert batch.merge(write_rows(tmp_path, [*found, lost]), tmp_path / "flat.csv") == 3
    *lines, last = read_csv(tmp_path / "flat.csv")
    assert ",".join(last) == (
        "id,status,iou,rms,fx,fy,cx,cy,R11,R12,R13,R21,R22,R23,R31,R32,R33,tx,ty,tz,"
        "sigma_rotation_b1_rad,sigma_rotation_b2_rad,sigma_rotation_v_rad,sigma_e_x,sigma_e_y,"
        "sigma_e_z,words"
    )
    for line, row in zip(lines, sorted(found, key=lambda row: max(row["std"][:3])), strict=True):
        fx, _, cx, _, fy, cy, *_ = row["K"]  # (the surest first)
        expected = [row["iou"], row["rms"], fx, fy, cx, cy, *row["R"], *row["t"], *row["std"]]
        (id, status, *numbers, words) = line.values()
        assert (id, status, words) == (row["id"], "converged", row["words"])
        assert [*map(float, numbers)] == expected
    known = {name: lost[name] for name in ("id", "status", "words")}
    assert {name: value for name, value in last.items() if value} == known


# Data sets.


def test_bop_split_becomes_records(folder, records):
    ids = ["test/000001/0/7/0", "test/000001/1/7/0", "test/000003/0/7/0", "test/000003/1/7/0"]
    assert [record["id"] for record in records] == ids
    assert records[0]["mesh"].endswith("obj_000007.ply")
    assert "free" not in records[0]
    scene = folder / "test" / "000003"
    one = list(batch.read_dataset(scene, free="pose,phi"))
    assert [record["id"] for record in one] == ids[2:]
    assert one[0]["free"] == "pose,phi"
    assert "start" not in one[0]
    # A scene's own K goes with its own centres; how a path is written makes no other id.
    known = batch.read_dataset(scene / "..", K=[1, 1, 0, 0], pixel_centres="half")
    first = next(iter(known))
    assert (known.kind, first["id"]) == ("BOP", ids[0])
    assert "pixel_centres" not in first


def test_detections_take_the_place_of_masks(folder, tmp_path):
    rle = {"size": [1, 2], "counts": [1, 1]}
    found = [
        {"scene_id": 3, "image_id": 1, "category_id": 7, "score": 0.5, "segmentation": rle},
        {"scene_id": 3, "image_id": 1, "category_id": 7, "score": 0.4, "segmentation": rle},
    ]
    (tmp_path / "found.json").write_text(json.dumps(found))
    data = list(batch.read_dataset(folder / "test", detections=tmp_path / "found.json"))
    assert [record["id"] for record in data] == ["test/000003/1/7/0", "test/000003/1/7/1"]
    assert data[0]["mask"] == rle


#: A BOP split of one scene; other tests put wrong files in their places.
LABELS, CAMERAS, FOUND = "test/1/scene_gt.json", "test/1/scene_camera.json", "found.json"
FINE = '{"scene_id": 1, "image_id": 0, "category_id": 7, "segmentation": null}'
LOST = FINE.replace("0,", '"a.png",')
SPLIT = {
    "models/x.ply": "",
    LABELS: '{"0": [{"obj_id": 7}]}',
    CAMERAS: '{"0": {}}',
    FOUND: f"[{FINE}]",
}


@pytest.mark.parametrize(
    "file, text, message",
    [
        (LABELS, "[]", r"`path`: expected a JSON object, got \[\] in .*scene_gt.json'"),
        (LABELS, '{"0": 3}', r"`0`: expected a list, got 3 \(in '.*scene_gt.json'\)"),
        (LABELS, '{"0": [{"obj_id": 1.5}]}', "`obj_id`: expected an integer .*, got 1.5 .*gt.json"),
        (CAMERAS, '{"0": null}', "`0`: expected fields with names, got None .*camera.json'"),
        (FOUND, '{"annotations": []}', "`detections`: expected a list, got .*annotations"),
        (FOUND, f"[{FINE}, {{}}]", r"`scene_id`: .* no such field .*found.json', detections\[1\]"),
        (FOUND, f"[{FINE.replace('1', '2')}]", r"'1'.* got \['000002'\] in .*found"),
        (FOUND, f"[{LOST}]", "`image_id`: expected an integer .*, got 'a.png'"),
        ("a.jsonl", '{"id": 1}\n\n{"id": \n', r"`path`: .* in line 3 of '.*a.jsonl': Expecting"),
        ("a.jsonl", '{"id": 1}\n\n[1]\n', r"`path`: .* object in line 3 of '.*a.jsonl'"),
        ("a.jsonl", b'\xff{"id": 1}', r"`path`: .* of '.*a.jsonl'"),
        ("a.txt", "", r"`path`.*\.csv"),
        ("other/a.txt", "", r"`path`.*got 0 meshes"),
    ],
)
def test_data_sets_of_other_kinds_are_refused(tmp_path, file, text, message):
    write_files(tmp_path, {**SPLIT, file: text})
    path = tmp_path / ("test" if file in SPLIT else file.removesuffix("/a.txt"))
    more = {"detections": tmp_path / FOUND} if file == FOUND else {}
    with refusal(message):
        list(batch.read_dataset(path, **more))


def test_data_set_without_what_is_asked_for_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"`path`.*a data set"):
        batch.read_dataset(tmp_path / "none")
    write_files(tmp_path, SPLIT)
    with refusal("`cam_R_m2c`: .* no such field .*scene_gt.json"):
        list(batch.read_dataset(tmp_path / "test", start=True))
    for name in ("colour", "models"):
        with refusal(f"`{name}`"):
            batch.read_dataset(tmp_path / "test", **{name: "none"})


def write_files(folder, files):
    for name, content in files.items():
        put(folder, name, content)


@pytest.mark.parametrize("ending", [".csv", ".jsonl"])
def test_table_of_records(records, rows, tmp_path, ending):
    path = tmp_path / f"data{ending}"
    relative = lambda record, name: os.path.relpath(record[name], tmp_path)
    plain = [
        {name: record[name] for name in ("id", "K", "start")}
        | {name: relative(record, name) for name in ("mesh", "mask")}
        for record in records
    ]
    if ending == ".jsonl":
        path.write_text("".join(f"{json.dumps(record)}\n\n" for record in plain))
    else:
        cell = lambda x: x if isinstance(x, str) else " ".join(map(str, np.ravel(x)))
        with open(path, "w", newline="") as stream:
            csv.writer(stream).writerows([plain[0], *(map(cell, x.values()) for x in plain)])
    data = list(batch.read_dataset(path))
    assert [record["id"] for record in data] == [record["id"] for record in records]
    row = batch.fit_one(data[0])
    assert (row["status"], row["R"]) == (rows[0]["status"], rows[0]["R"])


def test_csv_rows_may_be_short_and_name_what_is_too_long(tmp_path):
    (tmp_path / "data.csv").write_text("id,mesh,mask,fov\na,a.ply\nb,b.ply,b.png,30,more\n")
    short, long = batch.read_dataset(tmp_path / "data.csv", fov=40)
    assert short == {"id": "a", "mesh": str(tmp_path / "a.ply"), "fov": 40}
    assert "got no mask" in batch.fit_one(short)["words"]
    assert "`item`: expected fields among" in batch.fit_one(long)["words"]
    assert batch.fit_one(long)["words"].endswith("got 'a cell too many'")


def test_folder_of_masks_is_a_dataset(tmp_path):
    write_files(tmp_path, dict.fromkeys(("part.ply", "masks/b.png", "masks/a.png"), ""))
    first, _ = data = list(batch.read_dataset(tmp_path, fov=34.4))
    assert [record["id"] for record in data] == ["masks/a.png", "masks/b.png"]
    assert first["fov"] == 34.4
    (tmp_path / "camera.json").touch()
    first, _ = batch.read_dataset(tmp_path, fov=34.4)
    assert "fov" not in first
    assert first["camera"].endswith("camera.json")


# Many.


def test_threads_give_rows_in_order(records, rows):
    counts = []
    with ThreadPoolExecutor(2) as threads:
        found = batch.fit_many(records[::-1], executor=threads, progress=counts.append)
    assert timeless(found) == timeless(rows[::-1])
    assert [count.done for count in counts] == [1, 2, 3, 4]
    assert counts[-1].total == COUNT
    assert counts[-1].statuses == {"converged": COUNT}


def test_finished_rows_are_not_fitted_again(records, rows, tmp_path):
    """The rows that are there are marked: they have to stay."""
    there = rows[1] | {"words": "there before"}
    write_rows(tmp_path, [there, empty_row(records[3], "crashed", "")])
    counts = []
    run = lambda items, **more: batch.fit_many(items, out=tmp_path, progress=counts.append, **more)
    with ThreadPoolExecutor(1) as threads:
        found = run(iter(records), executor=threads)
        assert [row["words"] for row in found] == ["", "there before", "", ""]
        assert (counts[-1].done, counts[-1].total) == (2, None)
        found = run(records, executor=threads, retry=["crashed"])
    assert [row["status"] for row in found] == ["converged"] * COUNT
    assert len(run(records)) == COUNT  # no worker starts
    assert len(counts) == 3


def test_finished_rows_with_other_settings_are_refused(records, rows, tmp_path):
    write_rows(tmp_path, rows[:1])
    moved = records[0] | {"mask": "elsewhere.png", "mesh": "elsewhere.ply"}
    assert [*pj.fit_many([moved], out=tmp_path)] == [rows[0]]  # a mount of another name
    other = records[0] | {"max_steps": 7}
    words = rf"`out`.*{re.escape(other['id'])}.*'max_steps' was None, and now 7"
    for items in ([other], iter([other])):
        with refusal(words):
            pj.fit_many(items, out=tmp_path)  # no worker starts
    with refusal("'outlier_px' was None, and now null"):  # (null is a setting of its own)
        pj.fit_many([records[0] | {"outlier_px": None}], out=tmp_path)


def test_shards_make_the_whole(records, rows, tmp_path):
    with ThreadPoolExecutor(1) as threads:
        for k in (1, 2, 3):
            batch.fit_many(records, executor=threads, out=tmp_path, shard=(k, 3))
    assert timeless(batch.Results(tmp_path)) == timeless(rows)


def test_executor_that_is_shut_down_is_named():
    threads = ThreadPoolExecutor(1)
    threads.shutdown()
    with pytest.raises(RuntimeError, match=r"`executor`.*call again"):
        batch.fit_many([{"id": "a"}], executor=threads)


test_wrong_arguments_are_refused = refuses(
    batch.fit_many,
    {"items": []},
    {
        "`retry`.*'failed'": {"retry": "failed"},
        "`retry`.*'lost'": {"retry": ["lost"]},
        "`workers`.*got 0": {"workers": 0},
        r"`shard`.*\(0, 2\)": {"shard": (0, 2)},
        "`time_limit`.*-1": {"time_limit": -1.0},
        "`items`.*'a' twice": {"items": [{"id": "a"}, {"id": "a"}]},
    },
)


def test_progress_reads_as_a_sentence():
    count = batch.Count(30, 100, 20, {"converged": 28, "misfit": 2}, 60.0)
    assert str(count) == "50 of 100, 30.0 a minute, 0:01:40 left; 2 not converged"
    assert str(batch.Count(30, None, 0, {"converged": 30}, 3.0)) == "30, 10.0 a second"


#: What goes wrong in workers: the script is imported there, and changes what fits a record.
SCRIPT = """
import json, os, signal, sys, time
from pathlib import Path
from pinhole_jax import batch
from pinhole_jax.batch import parts, worker
from pinhole_jax.batch.rows import empty_row

def fit_one(record, last=None):
    kind = record["id"].split("-")[0]
    if kind == "kills":
        os.kill(os.getpid(), signal.SIGKILL)
    if kind == "once" and not os.path.exists(record["mask"]):
        open(record["mask"], "w").close()
        os.kill(os.getpid(), signal.SIGKILL)
    while kind == "loops":
        pass
    while kind == "waits" and not os.path.exists("go"):
        time.sleep(0.02)
    if kind == "sleeps":
        time.sleep(1000)
    time.sleep(0.02)
    return empty_row(record, "converged", str(os.getpid()))

worker.fit_one = fit_one
worker.PATIENCE, worker.GRACE, parts.ROWS = 1.0, 4.0, 40
worker._set_up = lambda setup: None  # no JAX: quick

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
    ids, out, limit = json.loads(sys.argv[1]), sys.argv[2], float(sys.argv[3])
    # (A path, and what no process can be handed, are whatever a user's own code makes.)
    items = [
        {"id": id, "mesh": Path("none"), "mask": f"{out}.{id}", "photo": (lambda: 0)}
        for id in ids
    ]
    batch.fit_many(items, workers=2, out=out, time_limit=limit or None)
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "script.py"
    path.write_text(SCRIPT)
    return path


def start(script, ids, out, limit=0.0, **more):
    return subprocess.Popen([sys.executable, script, json.dumps(ids), out, str(limit)], **more)


def finished(script, ids, out, limit=0.0, **more):
    """The results of a run that ended by itself."""
    assert start(script, ids, out, limit, **more).wait(60) == 0
    return batch.Results(out)


def test_worker_crash_costs_its_record_one_retry(script, tmp_path):
    ids = ["kills", *(f"fine-{k}" for k in range(6)), "once"]
    assert finished(script, ids, tmp_path / "out").counts() == {"converged": 7, "crashed": 1}


@pytest.mark.long
def test_record_that_takes_too_long_times_out(script, tmp_path):
    ids = ["loops", "sleeps", *(f"fine-{k}" for k in range(4))]
    results = finished(script, ids, tmp_path / "out", 1.0)
    assert results.counts() == {"converged": 4, "timed_out": 2}
    assert results.row("loops")["words"] == "took more than 1 s"
    assert "did not end by itself" in results.row("sleeps")["words"]


def wait_until(condition):
    end = time.monotonic() + 30
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize("number", first(1, [signal.SIGINT, signal.SIGKILL]))
def test_stopped_run_resumes(script, tmp_path, number):
    """Workers end with the process that asked, and what is done is not done again."""
    ids = [f"fine-{k:03d}" for k in range(60)]  # 40 rows are a part
    ids += [f"waits-{k}" for k in range(4)]
    out = tmp_path / "out"
    process = start(script, ids, out, stderr=subprocess.DEVNULL, cwd=tmp_path)
    wait_until(lambda: list(out.glob("part-*")))
    process.send_signal(number)
    process.wait(30)
    before = {row["id"]: row["words"] for row in batch.Results(out)}
    assert 40 <= len(before) <= 60
    for pid in set(before.values()):
        wait_until(lambda pid=pid: not Path(f"/proc/{pid}").exists())
    (tmp_path / "go").touch()
    after = {row["id"]: row["words"] for row in finished(script, ids, out, cwd=tmp_path)}
    assert sorted(after) == ids
    assert after | before == after


def test_script_without_main_guard_is_refused(tmp_path):
    path = tmp_path / "script.py"
    path.write_text("from pinhole_jax import batch\nbatch.fit_many([{'id': 'a'}])\n")
    done = python(path)
    assert done.returncode == 1
    assert "if __name__ == '__main__'" in done.stderr


@pytest.mark.long
def test_worker_processes_and_a_cluster_make_the_same_rows(folder, rows, tmp_path):
    """(By the compiler as users have it: rows of this process have other last digits.)"""
    path = tmp_path / "script.py"
    path.write_text(
        textwrap.dedent(
            """
            import sys
            from pinhole_jax import batch
            if __name__ == "__main__":
                items = list(batch.read_dataset(sys.argv[1], start=True))
                batch.fit_many(items, workers=2, out=sys.argv[2])
                from dask.distributed import Client, LocalCluster
                cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
                with cluster, Client(cluster) as client:
                    executor = client.get_executor(pure=False)
                    batch.fit_many(items, executor=executor, workers=2, out=sys.argv[3])
            """
        )
    )
    one, other = tmp_path / "one", tmp_path / "other"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    printed(path, folder / "test", one, other, env=environment)
    found = list(batch.Results(one))
    assert timeless(found) == timeless(batch.Results(other))
    for a, b in zip(found, rows, strict=True):
        assert a["status"] == b["status"]
        assert_allclose(a["R"], b["R"], atol=1e-4)


# The command.


def main(words):
    return command.main(["batch", *words.split()])


def test_command_writes_table_and_camera(rows, folder, tmp_path, capsys, monkeypatch):
    """What is there is written and told without a worker."""
    monkeypatch.chdir(tmp_path)

    def printed(words, status):
        assert main(words) == status
        return "".join(capsys.readouterr())

    write_rows(tmp_path / "out", rows)
    told = printed(f"-o out --merge table.jsonl --write {rows[0]['id']} camera.yaml", 0)
    assert f"rows       {COUNT}" in told
    assert f"{COUNT}   converged" in told
    assert len((tmp_path / "table.jsonl").read_text().splitlines()) == COUNT
    K, *_ = formats.to_opencv(formats.read_one("camera.yaml"), pixel_centres="integer")
    assert_allclose(K.ravel(), rows[0]["K"], rtol=1e-12)

    # All is done: nothing is to be fitted. But that has to be asked for.
    assert "--resume" in printed(f"{folder}/test -o out --start", 2)
    assert "`--output`: expected unchanged" in printed(f"{folder}/test -o out --resume", 2)
    assert printed(f"{folder}/test -o out --start --resume", 0)
    write_rows(tmp_path / "out", [failed("test/1/2/3/4", "`mask`: none")])
    told = printed("-o out --merge bop.csv", 1)
    assert "failure    test/1/2/3/4: `mask`: none\n" in told
    assert "bop.csv (without 1 rows that have no camera)" in told


def test_id_that_reads_as_a_path_leads_out_of_no_folder(rows, tmp_path, monkeypatch):
    """(A BOP split's ids have slashes.) No file is called by an id, in whatever format."""
    inside = tmp_path / "deep" / "inside"
    inside.mkdir(parents=True)
    monkeypatch.chdir(inside)
    ids = "../x", "../../x", "a/../../../x"
    with ThreadPoolExecutor(1) as threads:
        lost = [{"id": f"{id}.lost", "mesh": "none.ply", "mask": "none.png"} for id in ids]
        assert batch.fit_many(lost, executor=threads, out="out").ids() == {x["id"] for x in lost}
    write_rows(inside / "out", [rows[0] | {"id": id} for id in ids])
    for k, id in enumerate(ids):
        for name, ending in ENDINGS.items():
            main(f"-o out --merge {k}.csv --write {id} {k}{ending}")
            assert Path(f"{k}{ending}").exists(), name
    assert {path.relative_to(tmp_path).parts[:2] for path in tmp_path.rglob("*")} == {
        ("deep",),
        ("deep", "inside"),
    }


def test_command_hands_its_options_to_each_record(tmp_path, monkeypatch):
    items = []
    monkeypatch.setattr("pinhole_jax._command.batch.fit_many", lambda x, **_: items.extend(x))
    (tmp_path / "set.csv").write_text("id,mesh,mask,fov\na,a.ply,a.png,\nb,b.ply,b.png,30\n")
    words = "--K 9,9,4,4 --dist -0.1,0,0,0 --crop 1 2 8 8 --resize 8 8 --weight w.png --no-tidy"
    assert main(f"-o {tmp_path}/out {words} --free pose focal {tmp_path}/set.csv") == 0
    shared = {"crop": [1, 2, 8, 8], "resize": [8, 8], "weight": "w.png", "free": "pose,phi"}
    shared |= {"tidy": False}
    first, second = items
    files = {"mesh": str(tmp_path / "a.ply"), "mask": str(tmp_path / "a.png")}
    known = {"K": "9,9,4,4", "dist": "-0.1,0,0,0", "pixel_centres": "integer"}
    assert first == {"id": "a", **files, **known, **shared}
    assert second.keys() == {"id", "mesh", "mask", "fov", *shared}


@pairs(
    "arguments, words",
    {
        "-o none": "`DATASET`: expected a data set",
        "none.csv -o none --shard one": "`--shard`: expected I/N",
        "-o none --write a b.yaml": "`--write`.*'a'",
        "-o none --merge table.txt": "`--merge`.*.jsonl or .csv",
    },
)
def test_command_names_the_wrong_argument(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "none.csv").write_text("id,mesh,mask\n")
    assert main(arguments) == 2
    assert re.search(words, capsys.readouterr().err)


# Frames, each fitted from where the last one ended.

CAMERA = usual_camera(48, 40)
SCENE = lump(2)


@pytest.fixture
def frames(tmp_path):
    in_trimesh(SCENE.mesh).export(tmp_path / "part.ply")
    cameras = [turned(CAMERA, 3.0 * k, 1.0) for k in range(3)]
    for k, camera in enumerate(cameras):
        pj.io.save_image(tmp_path / f"{k}.png", drawn(camera, SCENE))
    fov = float(np.rad2deg(CAMERA.phi))
    files = {"mesh": str(tmp_path / "part.ply"), "fov": fov}
    return [{"id": f"{k}", "mask": str(tmp_path / f"{k}.png"), **files} for k in range(3)], cameras


def test_frames_are_tracked_from_one_to_the_next(frames, monkeypatch):
    records, cameras = frames
    starts = []
    fit_camera = pj.fit_camera

    def seen(scene, target, camera=None, **more):
        starts.append(camera)
        return fit_camera(scene, target, cameras[0] if camera is None else camera, free="pose")

    monkeypatch.setattr(pj, "fit_camera", seen)
    rows = pj.fit_many(records, track=True)
    assert [row["status"] for row in rows] == ["converged"] * 3
    assert starts[0] is None
    for start, before in zip(starts[1:], cameras, strict=False):
        angle, _ = pj.pose_error(start, before)
        assert np.rad2deg(float(angle)) < 0.2
    assert [json.loads(row["record"]) for row in rows] == records


def test_executor_beside_tracking_is_refused(frames):
    with ThreadPoolExecutor(1) as threads, refusal("with `track`"):
        pj.fit_many(frames[0], executor=threads, track=True)
