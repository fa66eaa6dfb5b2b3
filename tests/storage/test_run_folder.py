from softgm_bench.storage.run_folder import RunFolder


def test_checkpoints_are_in_the_order_of_frames_and_what_was_left_of_a_broken_write_is_none(tmp_path):
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    paths = [folder.checkpoints / f"frames-{frames:012d}.pt" for frames in (900, 1000, 20000)]
    for path in (*reversed(paths), folder.checkpoints / ".frames-000000030000.pt.tmp"):
        path.touch()

    assert folder.in_order() == paths
    assert folder.newest() == paths[-1]


def test_a_folder_that_does_not_exist_holds_no_checkpoint(tmp_path):
    folder = RunFolder(tmp_path / "nowhere")
    assert folder.in_order() == []
    assert folder.newest() is None
