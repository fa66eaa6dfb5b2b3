"""The interactive page: what it carries, that it is closed to the network, and that a browser shows it."""

import base64
import hashlib
import json
import os
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from softgm_bench.config import compose, plain
from softgm_bench.episodes.trajectory import Trajectory
from softgm_bench.errors import UserError
from softgm_bench.render.camera import direction
from softgm_bench.render.html import ATTENTION_BYTES, SCRIPTS, VIEWER, payload, render_page, write_html
from softgm_bench.rod.parameters import RodParameters

N, M, L, H = 6, 8, 2, 4  # agents, slots, layers, heads
STORED = {"uint8": "u1", "int8": "i1", "uint16": "<u2", "uint32": "<u4", "float32": "<f4"}


def bent_arm(steps: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and directors of an arm that bends from straight to an arc of 1.8 rad towards +x, stretched by 5 %."""
    arc = np.linspace(0.0, 1.05, n + 1)
    bend = np.linspace(1e-6, 1.8, steps + 1)[:, None] / 1.05
    x, z = (1.0 - np.cos(bend * arc)) / bend, np.sin(bend * arc) / bend
    position = np.stack([x, np.zeros_like(x), z], axis=1)
    tangent = np.diff(position, axis=-1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    d1 = np.zeros_like(tangent)
    d1[:, 1] = 1.0
    return position, np.stack([d1, np.cross(tangent, d1, axis=1), tangent], axis=1)


def an_episode(steps: int = 30, slots: int = M, used: int = 3, attention: bool = True, **info: str) -> Trajectory:
    """An arm that bends past a post of three bins, of which it discovers the first at step 0 and then one every 4."""
    rng = np.random.default_rng(0)
    config = plain(compose(["task=structured", f"task.slots={slots}"]))
    n = RodParameters().n_elements
    position, director = bent_arm(steps, n)
    discovered = np.minimum(4 * np.arange(used), steps)
    active = np.zeros((steps + 1, slots), dtype=bool)
    active[:, :used] = np.arange(steps + 1)[:, None] >= discovered
    near = np.arange(slots)[:, None] * 0.05
    middle = np.minimum(near + 0.025, 0.5 * (near + 0.12))  # the post is 0.12 m long, its third bin 0.02 m
    descriptor = np.concatenate(
        [np.full((slots, 2), 0.35), 0.5 + middle, np.tile([0.0, 0.0, 1.0, 0.05, 0.12], (slots, 1)), middle / 0.12],
        axis=1,
    )
    edge = active[:, None, :] & (rng.random((steps + 1, N, slots)) < 0.6)
    weights = {}
    if attention:
        heard = np.concatenate([np.broadcast_to(np.eye(N, dtype=bool), (steps, N, N)), edge[:-1]], axis=-1)
        chain = np.abs(np.subtract.outer(np.arange(N), np.arange(N))) <= 1
        weights = {
            "stage1": some_weights(rng, heard[:, None, None], (steps, L, H, N, N + slots)),
            "stage2": some_weights(rng, chain, (steps, L, H, N, N)),
        }
    terms = {"distance": rng.normal(size=steps), "progress": rng.normal(size=steps)}
    return Trajectory(
        position=position,
        director=director,
        velocity=np.zeros_like(position),
        omega=np.zeros((steps + 1, 3, n)),
        contact=rng.random((steps + 1, n + 1)) < 0.1,
        action=rng.uniform(-1.0, 1.0, (steps, N, 2)).astype(np.float32),
        tip_force=np.zeros((steps, 3)),
        reward=(terms["distance"] + terms["progress"]).astype(np.float32),
        target=position[-1, :, -1] + [0.0, 0.02, 0.0],
        observation={
            "agents/edge": edge,
            "slots/active": active,
            "slots/descriptor": (descriptor * active[..., None]).astype(np.float32),
        },
        reward_terms={name: row.astype(np.float32) for name, row in terms.items()},
        cylinders={
            "start": np.array([[0.35, 0.35, 0.5]]),
            "axis": np.array([[0.0, 0.0, 1.0]]),
            "length": np.array([0.12]),
            "radius": np.array([0.05]),
        },
        attention=weights,
        success=True,
        diverged=False,
        config=config,
        info={"label": "softgm", "task": "structured", "frames": 1000, "seed": 3, "episode": 0, "versions": {}} | info,
    )


def some_weights(rng: np.random.Generator, heard: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Rows that sum to one over what is heard."""
    raw = np.where(heard, rng.uniform(0.1, 1.0, shape), 0.0)
    return (raw / raw.sum(axis=-1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def episode() -> Trajectory:
    return an_episode()


def unpacked(packed: dict) -> np.ndarray:
    stored = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), STORED[packed["type"]]).reshape(
        packed["shape"]
    )
    return packed["offset"] + packed["scale"] * stored.astype(np.float64)


def carried(text: str) -> dict:
    """The episode in a page's text, read as a browser reads it."""
    found = re.search(r'<script type="application/json" id="episode">(.*?)</script>', text, re.DOTALL)
    assert found
    return json.loads(found[1])


class Tags(HTMLParser):
    """Every start tag of a page with its attributes, and the text of its heading."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.heading = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data):
        if self.tags and self.tags[-1][0] == "h1" and not self.heading:
            self.heading = data


# what the page carries


def test_positions_are_carried_to_a_thirtieth_of_a_millimetre(episode):
    found = unpacked(carried(render_page(episode))["arrays"]["position"])
    np.testing.assert_allclose(found, episode.position.transpose(0, 2, 1), atol=3e-5, rtol=0)


def test_radii_actions_and_normals_are_carried_to_their_stated_precision(episode):
    arrays = carried(render_page(episode))["arrays"]
    radius = episode.radius()
    np.testing.assert_allclose(unpacked(arrays["radius"]), radius, atol=0.51 * np.ptp(radius) / 255, rtol=0)
    np.testing.assert_allclose(unpacked(arrays["action"]), episode.action, atol=2.0 / 65535, rtol=0)
    np.testing.assert_allclose(
        unpacked(arrays["normal"]), episode.director[:, 0].transpose(0, 2, 1), atol=0.51 / 127, rtol=0
    )


def test_rewards_and_contacts_are_carried_exactly(episode):
    arrays = carried(render_page(episode))["arrays"]
    np.testing.assert_array_equal(unpacked(arrays["reward"]), episode.reward)
    np.testing.assert_array_equal(unpacked(arrays["terms"]), list(episode.reward_terms.values()))
    rows = unpacked(arrays["contact"]).astype(np.uint8)
    nodes = episode.contact.shape[1]
    np.testing.assert_array_equal(np.unpackbits(rows, axis=1, bitorder="little")[:, :nodes], episode.contact)


def test_bins_are_carried_with_the_step_of_their_discovery_and_the_last_one_of_a_post_is_shorter(episode):
    slots = carried(render_page(episode))["slots"]
    assert [slot["step"] for slot in slots] == [0, 4, 8]
    assert [slot["half"] for slot in slots] == pytest.approx([0.025, 0.025, 0.01], abs=1e-6)
    assert slots[2]["centre"] == pytest.approx([0.35, 0.35, 0.61], abs=1e-6)


@pytest.mark.parametrize("stage", ["stage1", "stage2"])
def test_attention_is_carried_to_half_a_255th(episode, stage):
    packed, weights = carried(render_page(episode))["attention"][stage], episode.attention[stage]
    begin, receiver, source = (unpacked(packed[name]).astype(int) for name in ("begin", "receiver", "source"))
    found = np.zeros_like(weights)
    for step in range(episode.steps):
        rows = slice(begin[step], begin[step + 1])
        found[step][:, :, receiver[rows], source[rows]] = unpacked(packed["weight"])[rows].transpose(1, 2, 0)
    assert packed["every"] == 1
    np.testing.assert_allclose(found, weights, atol=0.51 / 255, rtol=0)


def test_a_page_of_an_episode_without_attention_has_none():
    assert carried(render_page(an_episode(attention=False)))["attention"] == {}


def test_an_episode_without_obstacles_has_a_page():
    found = carried(render_page(an_episode(slots=0, used=0)))
    assert found["slots"] == []


def test_a_force_on_the_tip_is_carried_only_if_there_was_one(episode):
    assert "force" not in payload(episode)["arrays"]
    pushed = an_episode()
    pushed.tip_force[4] = [0.5, 0.0, -1.0]
    np.testing.assert_array_equal(unpacked(payload(pushed)["arrays"]["force"]), pushed.tip_force)


def test_numbers_that_are_not_finite_are_refused():
    broken = an_episode()
    broken.position[3, 0, 5] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        render_page(broken)


@pytest.mark.parametrize("obstacles", [0, 2, 15])
def test_the_page_looks_from_where_a_still_is_taken(obstacles):
    post = an_episode()
    seen = replace(post, cylinders={name: values.repeat(obstacles, axis=0) for name, values in post.cylinders.items()})
    camera = carried(render_page(seen))["camera"]
    assert (camera["azimuth"], camera["elevation"]) == pytest.approx(direction(seen), abs=1e-3)


# the page as a file


def test_the_same_episode_gives_the_same_bytes(tmp_path):
    for name in ("a.html", "b.html"):
        write_html(an_episode(), tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_page_of_200_steps_is_below_one_megabyte():
    assert len(render_page(an_episode(200, slots=64, used=40))) < 1_000_000


def test_a_page_of_2000_steps_with_every_bin_sensed_is_below_five_and_thins_out_attention():
    long = an_episode(2000, slots=128, used=128)
    text = render_page(long)
    assert len(text) < 5_000_000
    stages = carried(text)["attention"]
    assert stages["stage1"]["every"] > 1
    size = sum(unpacked(stage["weight"]).size for stage in stages.values())
    assert 0.3 * ATTENTION_BYTES < size <= ATTENTION_BYTES


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path, episode):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="choose a file that can be written"):
        write_html(episode, tmp_path / "file" / "page.html")


def test_title_caption_and_labels_cannot_break_out_of_the_page():
    evil = "</script></title><script>alert('{{episode}}')</script>&amp;"
    parser = Tags(render_page(an_episode(label=evil, seed=evil)))
    assert [tag for tag, _ in parser.tags].count("script") == 2
    assert parser.heading == f"structured · {evil}"
    assert carried(render_page(an_episode(label=evil)))["label"] == evil


def test_the_page_names_no_address_and_loads_nothing(episode):
    # three.js creates its own canvas by the name of a namespace, which is no address that anything is loaded from
    text = render_page(episode).replace('createElementNS("http://www.w3.org/1999/xhtml"', "", 1)
    assert not re.search(r"\b(https?|wss?|ftp)://|\bimport\s*\(|fetch\s*\(|XMLHttpRequest|@import|url\(", text)
    for tag, attributes in Tags(text).tags:
        assert "src" not in attributes, tag
        assert attributes.get("href", "data:,") == "data:,"


def test_the_policy_admits_this_script_and_this_style_alone(episode):
    text = render_page(episode)
    (policy,) = [a["content"] for _, a in Tags(text).tags if a.get("http-equiv") == "Content-Security-Policy"]
    rules = dict(rule.strip().split(" ", 1) for rule in policy.split(";"))
    assert rules["default-src"] == "'none'"
    for name, pattern in (("script-src", r"<script>(.*)</script>"), ("style-src", r"<style>(.*?)</style>")):
        content = re.search(pattern, text, re.DOTALL)
        assert content
        digest = base64.b64encode(hashlib.sha256(content[1].encode()).digest()).decode()
        assert rules[name] == f"'sha256-{digest}'"


def test_every_part_of_the_viewer_is_used():
    of_three = {"three/LICENSE", "three/README.md"}
    found = {path.relative_to(VIEWER).as_posix() for path in VIEWER.rglob("*") if path.is_file()}
    assert found == {*SCRIPTS, *of_three, "page.html", "style.css", "watch.html"}


def test_three_js_has_the_stated_version_and_stands_beside_its_licence():
    (stated,) = set(re.findall(r"three@0\.(\d+)\.\d+", (VIEWER / "three/README.md").read_text()))
    assert f'revision:"{stated}"' in (VIEWER / "three/three.min.js").read_text()
    licence = (VIEWER / "three/LICENSE").read_text()
    assert "The MIT License" in licence
    assert "three.js authors" in licence


def test_three_js_holds_what_the_page_uses_and_nothing_else():
    exported = re.findall(r"export \{(.*?)\}", (VIEWER / "three/README.md").read_text(), re.DOTALL)
    named = set(re.findall(r"\w+", " ".join(exported)))
    own = "".join((VIEWER / name).read_text() for name in SCRIPTS[1:])
    assert named == set(re.findall(r"THREE\.(\w+)", own)) | {"CatmullRomCurve3", "Color", "Vector3"}


# the page's own reading, in node


def run_node(arguments: list[str]) -> str:
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    done = subprocess.run([node, *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_script_is_valid_javascript(tmp_path, episode):
    script = re.search(r"<script>(.*)</script>", render_page(episode), re.DOTALL)
    assert script
    (tmp_path / "page.js").write_text(script[1])
    run_node(["--check", str(tmp_path / "page.js")])


def test_the_page_reads_what_was_recorded(tmp_path, episode):
    """Of a step: nodes, distance, return, mean attention, sensed bins; between steps the tip moves on smoothly."""
    parts = "".join((VIEWER / name).read_text() for name in ("three/three.min.js", "episode.js"))
    harness = """
    const page = require("fs").readFileSync(process.argv[2], "utf8");
    globalThis.document = { getElementById: () => ({ textContent: page }) };
    readEpisode().then((e) => {
      const edges = count(e.agents).map((a) => e.slots.map((_, s) => e.edge(12, a, s)));
      const at = (time) => rodAt(e, time).map((node) => [...node.centre]);
      console.log(JSON.stringify({ at: at(12), end: at(e.steps), tip: at(12.5)[e.nodes - 1],
        radius: rodAt(e, 12).map((node) => node.radius), contact: rodAt(e, 12).map((node) => node.contact),
        frames: rodAt(e, 12).map((node) => [[...node.first], [...node.second], [...node.tangent]]),
        distance: e.distance, returned: e.returned, edges, mean: weightsAt(e.attention.stage1, 12, null, null),
        one: weightsAt(e.attention.stage2, 12, 1, 2) }));
    });
    """
    (tmp_path / "read.js").write_text(parts + harness)
    (tmp_path / "episode.json").write_text(json.dumps(payload(episode)))
    found = json.loads(run_node([str(tmp_path / "read.js"), str(tmp_path / "episode.json")]))
    nodes = episode.position.transpose(0, 2, 1)
    np.testing.assert_allclose(np.reshape(found["at"], (-1, 3)), nodes[12], atol=4e-5)
    np.testing.assert_allclose(np.reshape(found["end"], (-1, 3)), nodes[-1], atol=4e-5)
    radius = episode.radius()[12]
    at_nodes = 0.5 * (np.append(radius[0], radius) + np.append(radius, radius[-1]))
    np.testing.assert_allclose(found["radius"], at_nodes, atol=1e-5)
    np.testing.assert_allclose(found["contact"], episode.contact[12], atol=1e-12)
    frames = np.array(found["frames"])
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (len(nodes[12]), 1, 1)), atol=1e-6
    )
    np.testing.assert_allclose(frames[:, 0], np.tile([0.0, 1.0, 0.0], (len(nodes[12]), 1)), atol=1e-2)
    distance = np.linalg.norm(nodes[:, -1] - episode.target, axis=-1)
    np.testing.assert_allclose(found["distance"], distance, atol=4e-5)
    np.testing.assert_allclose(found["returned"], [0.0, *np.cumsum(episode.reward, dtype=np.float64)], atol=1e-6)
    np.testing.assert_array_equal(found["edges"], episode.observation["agents/edge"][12, :, :3])
    # an arc moves on along a curve: halfway between two steps the cubic is much nearer to it than a straight line
    halfway, _ = bent_arm(2 * episode.steps, 60)
    np.testing.assert_allclose(found["tip"], halfway[25, :, -1], atol=1e-4)
    mean = episode.attention["stage1"][12].mean(axis=(0, 1))
    for edge in found["mean"]:
        assert edge["weight"] == pytest.approx(mean[edge["receiver"], edge["source"]], abs=0.51 / 255)
    assert {(e["receiver"], e["source"]) for e in found["mean"]} == set(zip(*np.nonzero(mean), strict=True))
    for edge in found["one"]:
        weight = episode.attention["stage2"][12, 1, 2, edge["receiver"], edge["source"]]
        assert edge["weight"] == pytest.approx(weight, abs=0.51 / 255)


def test_a_post_that_moves_and_its_bins_are_read_where_they_are(tmp_path, episode):
    """Bins were found at steps 0, 4 and 8, when the post was somewhere else each time."""
    shift = 0.2 * np.sin(np.arange(episode.steps + 1) / 9.0)[:, None, None] * [0.0, 1.0, 0.0]
    seen = dict(episode.observation)
    seen["slots/descriptor"] = seen["slots/descriptor"].copy()
    seen["slots/descriptor"][..., :3] += shift
    path = episode.cylinders["start"] + shift
    moving = replace(episode, cylinders=episode.cylinders | {"path": path}, observation=seen)
    parts = "".join((VIEWER / name).read_text() for name in ("three/three.min.js", "episode.js"))
    harness = """
    const page = require("fs").readFileSync(process.argv[2], "utf8");
    globalThis.document = { getElementById: () => ({ textContent: page }) };
    readEpisode().then((e) => console.log(JSON.stringify({
      still: [...shiftAt({ ...e, shift: undefined }, 0, 7)],
      shift: [0, 7, 7.25, e.steps].map((time) => [...shiftAt(e, 0, time)]),
      bins: [0, 7, e.steps].map((time) => e.slots.map((slot) => [...binAt(e, slot, time).centre])) })));
    """
    (tmp_path / "read.js").write_text(parts + harness)
    (tmp_path / "episode.json").write_text(json.dumps(payload(moving)))
    found = json.loads(run_node([str(tmp_path / "read.js"), str(tmp_path / "episode.json")]))
    away = shift[:, 0]
    expected = [away[0], away[7], 0.75 * away[7] + 0.25 * away[8], away[-1]]
    np.testing.assert_allclose(found["shift"], expected, atol=1e-5)
    assert found["still"] == [0.0, 0.0, 0.0]
    centres = episode.observation["slots/descriptor"][-1, :3, :3]
    for bins, step in zip(found["bins"], (0, 7, -1), strict=True):
        np.testing.assert_allclose(bins, centres + away[step], atol=1e-5)
    assert "shift" not in payload(episode)["arrays"]


# the page in a browser


def browse(page: str, *options: str) -> subprocess.CompletedProcess:
    names = [os.environ.get("CHROME", ""), "chromium", "chromium-browser", "google-chrome"]
    browser = next((path for path in map(shutil.which, filter(None, names)) if path), None)
    if browser is None:
        pytest.skip("no Chromium: set CHROME to its executable or put it on the PATH")
    sandbox = ["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []
    common = ["--headless", "--disable-dev-shm-usage", "--hide-scrollbars", "--enable-logging=stderr"]
    size = ["--window-size=900,600", "--virtual-time-budget=8000"]
    command = [browser, *common, *sandbox, *size, *options, page]
    return subprocess.run(command, capture_output=True, text=True, timeout=240)


@pytest.mark.slow
def test_a_browser_shows_arm_post_and_target_without_a_word_on_the_console(tmp_path, episode):
    image = pytest.importorskip("matplotlib.image", reason="matplotlib reads the screenshot")
    write_html(episode, tmp_path / "page.html")
    shot = tmp_path / "shot.png"
    software = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    done = browse(f"file://{tmp_path}/page.html#step=20", *software, f"--screenshot={shot}")
    assert shot.is_file(), done.stderr
    assert "CONSOLE" not in done.stderr, done.stderr
    scene = image.imread(shot)[:500, :560, :3]
    red, green, blue = scene[..., 0], scene[..., 1], scene[..., 2]
    assert ((red > 0.55) & (red > 1.5 * green) & (red > 1.5 * blue)).sum() > 1500  # the arm
    assert ((green > 0.5) & (green > 1.3 * red) & (blue > 1.2 * red)).sum() > 100  # discovered bins
    assert ((red > 0.75) & (green > 0.5) & (blue < 0.35)).sum() > 15  # the target


@pytest.mark.slow
def test_a_browser_without_webgl_draws_simply_and_says_so(tmp_path, episode):
    write_html(episode, tmp_path / "page.html")
    done = browse(f"file://{tmp_path}/page.html#step=20", "--disable-3d-apis", "--dump-dom")
    notice = re.search(r'<p id="notice"([^>]*)>([^<]*)<', done.stdout)
    assert notice, done.stderr
    assert "hidden" not in notice[1]
    assert "no WebGL 2" in notice[2]
    assert "20 / 30" in done.stdout  # it went on to draw
    assert "Uncaught" not in done.stderr, done.stderr
