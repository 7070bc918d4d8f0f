"""What do many fits cost, and what do they survive: killed workers and parents, clusters, shards?

Makes a data set as BOP's lie on disk (three shapes, hard masks of 256 px, starts some degrees off),
fits it by each engine, stops runs at random places and resumes them. `--items` says how many,
`--size` and `--faces` how large each is.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

#: Radius of the shapes, and how far the cameras are (mm).
RADIUS, NEAR, FAR = 100.0, 500.0, 650.0
#: Starts are off by this many degrees.
OFF_DEGREES = 5.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--items", type=int, default=1000)
    parser.add_argument("--rates", type=int, default=200, help="items of each row of the table")
    parser.add_argument("--only", choices=("engines", "rates", "memory"), action="append")
    parser.add_argument("--size", type=int, default=256, help="of the masks, in px")
    parser.add_argument("--faces", type=int, default=5120, help="of the largest shapes")
    parser.add_argument("--fitted", type=int, default=10_000, help="items of the memory's row")
    parser.add_argument("--run", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    data = options.out / "data"
    if options.run is not None:
        run(data / "test", **json.loads(options.run))
        return
    # (In a process of its own: what it compiles is none of the memory that is measured.)
    made = (data, options.items, options.size, options.faces)
    making = multiprocessing.get_context("spawn").Process(target=make, args=made)
    making.start()
    making.join()
    assert making.exitcode == 0
    path = options.out / "batch.json"
    answer = json.loads(path.read_text()) if path.exists() else {}
    asked = options.only or ("engines", "rates", "memory")
    for name in asked:
        count = {"engines": options.items, "rates": options.rates, "memory": options.fitted}[name]
        ask = {"engines": engines, "rates": rates, "memory": memory}[name]
        inputs = {"mask (px)": options.size, "faces": options.faces}
        found = ask(options.out, count)
        answer[name] = found if name == "rates" else inputs | found
        path.write_text(json.dumps(answer, indent=1) + "\n")
        print(json.dumps(answer[name], indent=1))


def make(folder: Path, count: int, size: int, faces: int) -> None:
    """Write a data set of this many pictures, each of one object; 100 to a scene."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import pinhole_jax as pj
    from pinhole_jax import formats, io

    made = f"{count} of {size} px, {faces} faces"
    if (folder / "count").is_file() and (folder / "count").read_text() == made:
        return
    finest = round(np.log2(faces / 20) / 2)  # an icosahedron's faces, in four at each level
    seed = np.random.default_rng(0)
    shapes, draw = [], jax.jit(pj.silhouette)
    (folder / "models").mkdir(parents=True, exist_ok=True)
    for number, fine in enumerate((finest, finest, finest - 1), 1):
        mesh = pj.shapes.bumpy(fine)
        points = RADIUS * np.asarray(mesh.vertices) * [1 + 0.15 * number, 1, 1]
        write_ply(folder / "models" / f"obj_{number:06d}.ply", points, np.asarray(mesh.faces))
        shapes.append(pj.Scene(mesh=pj.Mesh(points, mesh.faces)))
    for first in range(0, count, 100):
        place = folder / "test" / f"{first // 100 + 1:06d}"
        (place / "mask_visib").mkdir(parents=True, exist_ok=True)
        cameras, objects = {}, {}
        for k in range(min(100, count - first)):
            number = int(seed.integers(len(shapes)))
            eye = seed.normal(size=3)
            eye *= seed.uniform(NEAR, FAR) / np.linalg.norm(eye)
            aim, up = 8 * seed.normal(size=3), seed.normal(size=3)
            camera = pj.Camera(eye, aim, up, 0.6, 1.0, size, size)
            mask = np.asarray(draw(camera, shapes[number])) > 0.5
            io.save_image(place / "mask_visib" / f"{k:06d}_000000.png", mask)
            K, R, t = formats.to_opencv(camera, pixel_centres="integer")
            cameras[str(k)] = {"cam_K": K.ravel().tolist(), "depth_scale": 1.0}
            pose = {"cam_R_m2c": (off(seed) @ R).ravel().tolist(), "cam_t_m2c": t.tolist()}
            objects[str(k)] = [pose | {"obj_id": number + 1}]
        (place / "scene_camera.json").write_text(json.dumps(cameras))
        (place / "scene_gt.json").write_text(json.dumps(objects))
    (folder / "count").write_text(made)


def off(seed: np.random.Generator) -> np.ndarray:
    """Return a small rotation about the view axis and the two across it."""
    from scipy.spatial.transform import Rotation

    axis = seed.normal(size=3)
    return Rotation.from_rotvec(np.deg2rad(OFF_DEGREES) * axis / np.linalg.norm(axis)).as_matrix()


def write_ply(path: Path, points: np.ndarray, faces: np.ndarray) -> None:
    import trimesh

    trimesh.Trimesh(points, faces, process=False).export(path)


def run(data: Path, engine: str, out: str, workers: int, count: int, shard: list[int]) -> None:
    """Fit a data set in this process's name, by an engine."""
    from pinhole_jax import batch

    items = list(batch.read_dataset(data, start=True))[:count]
    more = {"out": out, "workers": workers, "shard": tuple(shard)}
    if engine == "cluster":
        from dask.distributed import Client, LocalCluster

        with (
            LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
            Client(cluster) as client,
        ):
            batch.fit_many(items, executor=client.get_executor(pure=False), **more)
    elif engine == "threads":
        import jax

        import pinhole_jax as pj

        jax.config.update("jax_enable_x64", True)
        pj.cache()
        with ThreadPoolExecutor(workers) as threads:
            batch.fit_many(items, executor=threads, **more)
    else:
        batch.fit_many(items, **more)


def started(
    folder: Path, engine: str, out: Path, workers: int = 2, count: int = 10**9, shard=(1, 1)
) -> subprocess.Popen:
    """Start a run in a process of its own."""
    asked = {"engine": engine, "out": str(out), "workers": workers, "count": count, "shard": shard}
    command = [sys.executable, __file__, str(folder), "--run", json.dumps(asked)]
    return subprocess.Popen(command, start_new_session=True)


def engines(folder: Path, count: int) -> dict:
    """Return whether all ways to fit a data set end with the same table."""
    with tempfile.TemporaryDirectory() as place:
        whole = Path(place) / "whole"
        begin = time.perf_counter()
        assert started(folder, "processes", whole).wait() == 0
        seconds = time.perf_counter() - begin
        expected = table(whole)
        answer = {
            "items": len(expected),
            "seconds": seconds,
            "statuses": statuses(whole),
        }
        stopped = Path(place) / "stopped"
        kills = stopped_at_random(folder, stopped, seconds)
        answer["killed workers"], answer["killed parents"] = kills
        answer["stopped and resumed: same"] = table(stopped) == expected
        cluster = Path(place) / "cluster"
        assert started(folder, "cluster", cluster).wait() == 0
        answer["dask.distributed: same"] = table(cluster) == expected
        shards = Path(place) / "shards"
        processes = [started(folder, "processes", shards, 1, shard=(k, 4)) for k in range(1, 5)]
        assert not any(process.wait() for process in processes)
        answer["four shards: same"] = table(shards) == expected
    return answer


def table(folder: Path) -> list[str]:
    """Return a run's merged table but for its seconds, line by line."""
    from pinhole_jax import batch
    from pinhole_jax.batch.rows import line_of

    return [line_of({**row, "seconds": 0.0}) for row in batch.Results(folder)]


def statuses(folder: Path) -> dict[str, int]:
    from pinhole_jax import batch

    return batch.Results(folder).counts()


def stopped_at_random(folder: Path, out: Path, seconds: float) -> tuple[int, int]:
    """Kill workers and parents at random times until all is done; return how many of each.

    A record that is tried again, alone, is spared: whose process ends twice has `crashed`.
    """
    chance = random.Random(0)
    workers = parents = 0
    while True:
        process = started(folder, "processes", out)
        until = time.perf_counter() + chance.uniform(0.2, 0.6) * seconds
        while process.poll() is None and time.perf_counter() < until:
            time.sleep(chance.uniform(0.05, 0.2) * seconds)
            own = children(process.pid)
            if len(own) > 1 and chance.random() < 0.7:
                workers += kill(chance.choice(own))
        if process.poll() is not None:
            assert process.returncode == 0
            return workers, parents
        parents += kill(process.pid)
        process.wait()


def children(pid: int) -> list[int]:
    """Return the worker processes of a process."""
    try:
        own = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        return [int(n) for n in own if "spawn_main" in Path(f"/proc/{n}/cmdline").read_text()]
    except OSError:
        return []


def kill(pid: int) -> int:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return 0
    return 1


def rates(folder: Path, count: int) -> list[dict]:
    """Return items per second, and processor time per item, of each engine.

    The first items of a process, which it starts and loads programs for, are not counted: a run of
    a few is subtracted.
    """
    answer = []
    for engine, workers in (("threads", 1), ("threads", 2), ("processes", 1), ("processes", 2)):
        few, many = (timed(folder, engine, workers, n) for n in (count // 10, count))
        items = count - count // 10
        answer.append(
            {
                "engine": engine,
                "workers": workers,
                "items a second": items / (many[0] - few[0]),
                "processor ms an item": 1e3 * (many[1] - few[1]) / items,
                "seconds to start": few[0] - (count // 10) * (many[0] - few[0]) / items,
            }
        )
        print(answer[-1])
    return answer


def timed(folder: Path, engine: str, workers: int, count: int) -> tuple[float, float]:
    """Return the seconds, and the processor's, that a run of this many items takes."""
    with tempfile.TemporaryDirectory() as place:
        before, begin = used(), time.perf_counter()
        assert started(folder, engine, Path(place) / "out", workers, count).wait() == 0
        return time.perf_counter() - begin, used() - before


def used() -> float:
    """Return the processor time of all processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def memory(folder: Path, count: int) -> dict:
    """Return what memory the parent and a worker hold while 100 000 records are planned, and so
    many fitted."""
    from pinhole_jax import batch

    items = list(batch.read_dataset(folder / "data" / "test", start=True))
    planned = 100_000

    def repeated() -> Iterator[dict]:
        for k in range(planned):
            yield {**items[k % len(items)], "id": f"{k}"}

    held: list[tuple[int, float, float]] = []
    done = 0

    def told(found: batch.Count) -> None:
        nonlocal done
        done = found.done
        if done % max(count // 20, 1) == 0:
            workers = [megabytes(pid) for pid in children(os.getpid())]
            held.append((done, megabytes(os.getpid()), max(workers)))
        if done >= count:
            raise KeyboardInterrupt

    with tempfile.TemporaryDirectory() as place:
        data = batch.Dataset("repeated", repeated)
        with contextlib.suppress(KeyboardInterrupt):
            batch.fit_many(data, out=Path(place) / "out", progress=told)
        rows = len(batch.Results(Path(place) / "out"))
    done_then, *sizes = np.array(held[len(held) // 4 :]).T  # the first load what they need
    slopes = [1e3 * float(np.polyfit(done_then, size, 1)[0]) for size in sizes]
    return {
        "planned": planned,
        "fitted": rows,
        "MB more for 1000 items: parent, worker": slopes,
        "done, MB of the parent, MB of the largest worker": held,
    }


def megabytes(pid: int) -> float:
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0.0
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


if __name__ == "__main__":
    main()
