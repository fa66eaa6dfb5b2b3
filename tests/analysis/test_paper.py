from softgm_bench.analysis import paper


def test_cells_of_table_one_are_the_papers():
    assert paper.table_one("basic", "ippo") == paper.Row((831.9, 884.5), (15.3576, 24.1946), (71.71, 10.48), 65.67)
    assert paper.table_one("structured", "iddpg").torque == (72.53, 1.83)
    assert paper.table_one("structured", "softgm").episode_length == (16.1, 2.9)
    assert paper.table_one("wall", "maddpg").success_rate == 26.15
    assert paper.table_one("wall", "masac").tip_travel_distance == (19.5661, 11.0627)
    assert paper.table_one("wall", "softgm") == paper.Row((1297.5, 907.0), (66.4659, 46.5124), (72.24, 1.64), 41.33)


def test_cells_of_table_two_are_the_papers():
    assert paper.table_two("wall", "softgm", "noise").success_rate == 37.33
    assert paper.table_two("wall", "softgm", "section_failure") == paper.Row(
        (1464.5, 772.0), (68.6340, 39.0639), (73.17, 0.63), 36.00
    )
    assert paper.table_two("wall", "softgm", "disturbance").tip_travel_distance == (66.6386, 43.0307)
    assert paper.table_two("wall", "softgm", "none") == paper.table_one("wall", "softgm")


def test_success_rates_are_those_that_the_specification_of_the_benchmark_repeats():
    rates = {label: [paper.table_one(task, label).success_rate for task in paper.TASKS] for label in paper.ALGORITHMS}
    assert rates == {
        "iddpg": [100, 82, 11],
        "ippo": [65.67, 0, 0],
        "isac": [100, 33.67, 0],
        "maddpg": [100, 100, 26.15],
        "mappo": [33.33, 0, 0],
        "masac": [100, 100, 0],
        "softgm": [100, 100, 41.33],
    }


def test_a_dash_of_the_paper_is_none():
    dashes = [
        (task, label)
        for task in paper.TASKS
        for label in paper.ALGORITHMS
        if paper.table_one(task, label).torque is None
    ]
    assert dashes == [("structured", "ippo"), ("structured", "mappo"), ("wall", "ippo"), ("wall", "mappo")]


def test_what_the_paper_does_not_have_is_none():
    assert paper.table_one("wall", "mappo_softgm") is None
    assert paper.table_one("robustness", "noise") is None
    assert paper.table_two("basic", "softgm", "noise") is None
    assert paper.table_two("wall", "softgm", "earthquake") is None
