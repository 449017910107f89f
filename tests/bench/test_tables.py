from torchmeso.bench import tables


def test_columns_are_the_papers():
    assert [name for name, _, _ in tables.COLUMNS] == ["btf", "silhouette", "shadow"]
    assert [shadow for _, _, shadow in tables.COLUMNS] == [False, False, True]
