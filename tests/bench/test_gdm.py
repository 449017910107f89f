from torchmeso.bench import gdm


def test_names_are_no_beginnings_of_one_another():
    names = [m.name for m in gdm.MEASUREMENTS]
    assert len(set(names)) == len(names)
