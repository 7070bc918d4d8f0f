"""Does the bench in the browser work? A script clicks through it in headless Chromium: turn, paint,
fit, export, save, and a second tab that knows nothing of the first.

It needs `pip install -e '.[studio]' playwright` and a Chromium (CHROMIUM names it; else it is
looked for), and says so where they are missing.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np

import pinhole_jax as pj

FLAGS = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
SIZE = {"width": 1360, "height": 860}
#: Strokes on the photo (px): on the cup and on its saucer.
STROKES = (
    [(200, 160), (215, 120), (300, 150), (390, 170), (395, 120)],
    [(150, 190), (130, 250), (160, 300), (240, 350), (330, 365), (420, 300), (460, 210)],
    [(290, 30), (330, 45)],
)
#: The spoon's handle sticks out: it is taken off the mask.
SPOON = [(417, 66), (415, 104)]
FACES = 5000


class Page:
    """A tab with the studio in it, and hands for it."""

    def __init__(self, context, address: str) -> None:
        self.page = context.new_page()
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", self._heard)
        self.page.goto(address)
        self.wait("studio.ready")

    def _heard(self, message) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def wait(self, condition: str, seconds: float = 90) -> None:
        self.page.wait_for_function(f"() => {condition}", timeout=1000 * seconds)

    def idle(self) -> None:
        self.wait("!studio.busy")

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Return where on the screen a place of the photo is."""
        return tuple(
            self.page.evaluate(
                "([x, y]) => [zoom.x + zoom.scale * x, zoom.y + zoom.scale * y]", [x, y]
            )
        )

    def drag(self, places, steps: int = 8) -> None:
        mouse, (first, *others) = self.page.mouse, [self.at(*place) for place in places]
        mouse.move(*first)
        mouse.down()
        for place in others:
            mouse.move(*place, steps=steps)
        mouse.up()

    def tool(self, name: str) -> None:
        self.page.click(f"[data-tool={name}]")

    def shot(self, path: Path) -> None:
        self.page.wait_for_timeout(300)
        self.page.screenshot(path=str(path), type="jpeg", quality=80)


def served(files: list[str], folder: Path) -> tuple[subprocess.Popen, str]:
    """Return a studio's process and its address."""
    command = [sys.executable, "-m", "pinhole_jax", "studio", *files, "--no-browser", "-o", folder]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if found := re.search(r"http://\S+", line):
            return process, found[0]
        print(line, end="", file=sys.stderr)
    sys.exit("the studio did not start")


def refused(address: str) -> dict[str, int]:
    """Return the status of requests without the token, and with another host's name."""
    bare, token = address.split("?")
    asked = {
        "page": (bare, {}),
        "wrong token": (f"{bare}?token=x", {}),
        "script": (f"{bare}studio.js", {}),
        "bench": (f"{bare}bench", {"Upgrade": "websocket", "Connection": "Upgrade"}),
        "other host": (f"{bare}?{token}", {"Host": "example.com"}),
        "other site": (f"{bare}?{token}", {"Origin": "http://example.com"}),
    }
    status = {}
    for name, (url, headers) in asked.items():
        try:
            with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as answer:
                status[name] = answer.status
        except urllib.error.HTTPError as error:
            status[name] = error.code
    return status


def coffee(folder: Path) -> list[str]:
    """Return the files of the coffee cup, made where they are not there."""
    if not (folder / "cup.ply").exists():
        script = Path(__file__).with_name("coffee_cup.py")
        subprocess.run([sys.executable, script, folder], check=True)
    return [str(folder / "cup.ply"), str(folder / "photo.png")]


def faces_and_photo(folder: Path) -> list[str]:
    """Return the files of a mesh of some 5k faces and of a picture of it."""
    mesh = pj.shapes.bumpy()
    camera = pj.Camera([0, 1, 5], [0, 0, 0], [0, 1, 0], 0.6, 1.0, 640, 480)
    lines = [f"v {x} {y} {z}" for x, y, z in np.asarray(mesh.vertices)]
    lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(mesh.faces) + 1]
    (folder / "bumpy.obj").write_text("\n".join(lines) + "\n")
    pj.io.save_image(folder / "bumpy.png", np.asarray(pj.silhouette(camera, pj.Scene(mesh=mesh))))
    return [str(folder / "bumpy.obj"), str(folder / "bumpy.png")]


def click_through(context, address: str, out: Path, pictures: Path) -> dict:
    """Turn, paint, fit and export; return what was seen."""
    seen: dict = {}
    one = Page(context, address)
    one.drag([(300, 200), (300, 320)])
    one.drag([(300, 200), (270, 200)])
    one.shot(pictures / "studio_turned.jpg")
    one.tool("object")
    for stroke in STROKES:
        one.drag(stroke)
        one.idle()
    mask = pj.io.load_mask(pictures / "mask.png") > 127
    painted = np.array(
        one.page.evaluate(
            "() => Array.from(maskImage.getContext('2d').getImageData(0, 0, W, H).data)"
            ".filter((_, k) => k % 4 == 3)"
        )
    ).reshape(mask.shape)
    seen["mask_iou"] = float(np.sum(mask & (painted > 0)) / np.sum(mask | (painted > 0)))
    one.tool("erase")
    one.drag(SPOON)
    one.idle()
    one.shot(pictures / "studio_painted.jpg")
    one.tool("turn")
    one.page.click("#fit")
    one.wait("studio.fit && !studio.busy")
    one.shot(pictures / "studio.jpg")
    seen["status"], seen["iou"] = one.page.evaluate("[studio.fit.status, studio.fit.iou]")
    seen["modes"] = one.page.evaluate("studio.fit.modes.length")
    one.page.fill("#name", "cup")
    one.page.click("#export")
    one.wait("document.querySelectorAll('#written li').length > 5")
    one.page.click("#save")
    one.wait("document.querySelector('#written li').textContent.endsWith('.studio.json')")
    seen["written"] = sorted(path.name for path in out.iterdir())
    two = Page(context, address)
    seen["second_tab_is_new"] = two.page.evaluate("!studio.mask.png && !studio.fit")
    two.page.set_input_files("#session-file", str(out / "cup.studio.json"))
    two.wait("studio.ready && studio.mask.png")
    views = [p.page.evaluate("JSON.stringify(studio.view.camera.eye)") for p in (one, two)]
    seen["session_restores"] = views[0] == views[1]
    two.page.set_input_files("#mask-file", str(pictures / "mask.png"))
    two.wait("studio.mask.guides.length === 0")
    one.page.reload()
    one.wait("studio.ready")
    seen["reload_keeps"] = one.page.evaluate("Boolean(studio.mask.png && studio.fit)")
    two.page.set_viewport_size({"width": 420, "height": 860})
    two.shot(pictures / "studio_narrow.jpg")
    seen["errors"] = one.errors + two.errors
    return seen


def drawing_seconds() -> float:
    """Return the processor time of Chromium's drawing process so far; 0 where /proc is not."""
    seconds = 0.0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command = (folder / "cmdline").read_bytes()
            times = (folder / "stat").read_text().rsplit(")", 1)[1].split()[11:13]
        except OSError:  # it has just ended
            continue
        if b"--type=gpu-process" in command:
            seconds += sum(map(int, times)) / os.sysconf("SC_CLK_TCK")
    return seconds


def rates(context, address: str) -> dict[str, float]:
    """Return how many outlines a second a tab gets (one question after another), how many it shows
    while the mesh is dragged, and for how long (ms) the page itself works on one, and the process
    in which Chromium draws."""
    page = Page(context, address)
    seconds = page.page.evaluate(
        "async () => { const begin = performance.now();"
        " for (let k = 0; k < 100; k++) await ask('move', { turn: [0.02, 0.01, 0] });"
        " return (performance.now() - begin) / 1000; }"
    )
    script = "() => { const t = performance.now(); drawAll(); return performance.now() - t; }"
    drawing = np.median([page.page.evaluate(script) for _ in range(20)])
    page.drag([(320, 240), (330, 250)])
    mouse, (x, y) = page.page.mouse, page.at(320, 240)
    mouse.move(x, y)
    mouse.down()
    before, busy = page.page.evaluate("studio.shown"), drawing_seconds()
    begin = time.perf_counter()
    while (elapsed := time.perf_counter() - begin) < 4:
        mouse.move(x + 150 * np.sin(2 * elapsed), y + 80 * np.cos(3 * elapsed))
        page.page.wait_for_timeout(10)
    updates, busy = page.page.evaluate("studio.shown") - before, drawing_seconds() - busy
    mouse.up()
    got, shown = round(100 / seconds, 1), round(updates / elapsed, 1)
    return {
        "got": got,
        "shown": shown,
        "ms_of_the_page": round(float(drawing), 2),
        "ms_of_chromiums_drawing": round(1000 * busy / updates, 1),
        "load": round(os.getloadavg()[0], 1),
    }


def main() -> None:
    chromium = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("chrome")
    try:
        import aiohttp  # noqa: F401
        from playwright.sync_api import sync_playwright
    except ModuleNotFoundError as error:
        sys.exit(f"not run: {error}; pip install -e '.[studio]' playwright")
    if chromium is None:
        sys.exit("not run: no Chromium; CHROMIUM may name one")
    pictures = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    pictures.mkdir(exist_ok=True)
    out = pictures / "studio"
    shutil.rmtree(out, ignore_errors=True)
    files = coffee(pictures)
    with sync_playwright() as play, tempfile.TemporaryDirectory() as profile:
        context = play.chromium.launch_persistent_context(
            profile, executable_path=chromium, headless=True, args=FLAGS, viewport=SIZE
        )
        process, address = served([*files, "--up", "z", "--fov", "20"], out)
        try:
            seen = {"refused": refused(address), **click_through(context, address, out, pictures)}
        finally:
            process.terminate()
        process, address = served(faces_and_photo(pictures), out)
        try:
            seen["outlines_per_second"] = rates(context, address)
        finally:
            process.terminate()
        context.close()
    print(
        f"The mask from {len(STROKES)} strokes has IoU {seen['mask_iou']:.3f} with the careful one;"
        f" the fit: {seen['status']}, IoU {seen['iou']:.3f}; {len(seen['written'])} files written;"
        f" {seen['outlines_per_second']['got']:.0f} outlines a second of {FACES} faces,"
        f" {seen['outlines_per_second']['shown']:.0f} of them drawn without a GPU while dragging."
    )
    print(json.dumps(seen, indent=1))
    (pictures / "studio.json").write_text(json.dumps(seen, indent=1) + "\n")
    good = (
        set(seen["refused"].values()) == {403}
        and seen["second_tab_is_new"]
        and seen["session_restores"]
        and seen["reload_keeps"]
        and not seen["errors"]
    )
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
