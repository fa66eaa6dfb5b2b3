import pytest
from small import POLICY, Asked, write

from interrupted_writing import interrupt_second_chunk
from softgm_bench.datasets import chunks, writing
from softgm_bench.errors import UserError

ASKED = Asked(["random", POLICY.format(task="basic")])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "x"
    write(folder, ASKED)
    return folder


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_an_interrupted_writing_that_goes_on_makes_the_same_bytes(whole, tmp_path, monkeypatch):
    interrupt_second_chunk(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "x", ASKED)
    assert sorted(content(tmp_path / "x")) == ["chunk-00000.tdz", "dataset.json"]
    (tmp_path / "x/.chunk-00001.tdz.tmp.tdz").touch()  # as if it had been killed
    write(tmp_path / "x", ASKED)
    assert len(writing.written(whole)) >= 2
    assert content(tmp_path / "x") == content(whole)


def test_a_full_disk_leaves_whole_chunks_and_says_so(whole, tmp_path, monkeypatch):
    original, calls = chunks.write, []

    def full(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise OSError(28, "No space left on device")
        original(*arguments)

    monkeypatch.setattr(chunks, "write", full)
    says = "No space left on device; whole chunks so far: 1, the same command goes on from there"
    with pytest.raises(UserError, match=says):
        write(tmp_path / "x", ASKED)
    assert content(tmp_path / "x")["chunk-00000.tdz"] == content(whole)["chunk-00000.tdz"]


def test_another_seed_makes_other_data(whole, tmp_path):
    write(tmp_path / "x", Asked(ASKED.sources, seed=1))
    assert content(tmp_path / "x")["chunk-00000.tdz"] != content(whole)["chunk-00000.tdz"]


def test_other_settings_do_not_go_on_with_it(whole):
    with pytest.raises(UserError, match="holds a data set with seed=0 and not 3: choose another folder"):
        write(whole, Asked(ASKED.sources, seed=3))
    with pytest.raises(UserError, match="holds a data set with another policies"):
        write(whole, Asked([*ASKED.sources, "random"]))


def test_the_last_bits_of_an_unfinished_one_are_not_mixed(whole, tmp_path):
    _, _, settings = ASKED.load()
    assert writing.begin(whole, settings | {"threads": 2, "command": "written otherwise"})  # finished: nothing is made
    writing.begin(tmp_path / "x", settings)
    assert not writing.begin(tmp_path / "x", settings | {"command": "written otherwise"})
    with pytest.raises(UserError, match="threads=1 and not 2"):
        writing.begin(tmp_path / "x", settings | {"threads": 2})


def test_what_is_acted_in_must_be_the_same_but_a_later_version_may_have_more_settings(whole):
    _, _, settings = ASKED.load()
    config = settings["config"]
    more = config | {"algo": None, "task": config["task"] | {"added": 0}}
    assert writing.begin(whole, settings | {"config": more})
    before = {key: value for key, value in config.items() if key != "randomise"}
    assert writing._alike("config", {"config": before}, {"config": config})
    bodies = {"randomise": config["randomise"] | {"name": "x", "density": [0.9, 1.1]}}
    for other in ({"dtype": "float32"}, {"task": config["task"] | {"success_radius": 0.1}}, bodies):
        with pytest.raises(UserError, match="holds a data set with another config"):
            writing.begin(whole, settings | {"config": config | other})


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    _, _, settings = ASKED.load()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(UserError, match="exists and is no data set"):
        writing.begin(tmp_path, settings)
    (tmp_path / writing.SETTINGS).write_text("{")
    with pytest.raises(UserError, match="damaged"):
        writing.begin(tmp_path, settings)
    (tmp_path / writing.SETTINGS).write_text('{"format": 99}')
    with pytest.raises(UserError, match="another version"):
        writing.begin(tmp_path, settings)


def test_one_changed_bit_is_found(whole, tmp_path):
    writing.verify(whole)
    copy = tmp_path / "x"
    copy.mkdir()
    for name, bytes_ in content(whole).items():
        (copy / name).write_bytes(bytes_)
    file = copy / "chunk-00001.tdz"
    middle = file.stat().st_size // 2
    changed = bytearray(file.read_bytes())
    changed[middle] ^= 1
    file.write_bytes(changed)
    with pytest.raises(UserError, match=r"chunk-00001.tdz: it is not what SHA256SUMS says"):
        writing.verify(copy)
    file.unlink()
    with pytest.raises(UserError, match="No such file"):
        writing.verify(copy)


def test_every_policy_has_its_share_and_no_episode_more(whole):
    columns = writing.episodes_of(whole)
    for number in range(2):
        lengths = columns["length"][columns["policy"] == number]
        assert lengths[:-1].sum() < ASKED.transitions / 2 <= lengths.sum()
    assert len(set(zip(columns["seed"].tolist(), columns["environment"].tolist(), strict=True))) == len(columns["seed"])
