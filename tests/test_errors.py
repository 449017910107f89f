import pytest
import torch

from torchmeso import errors


@pytest.mark.errors
def test_shape_error_names_the_argument_and_both_shapes():
    with pytest.raises(errors.ShapeError, match=r"uv: expected shape \(any, 2\), got \(4, 3\)"):
        errors.check_shape("uv", torch.zeros(4, 3), (-1, 2))


def test_shape_that_fits_passes():
    errors.check_shape("uv", torch.zeros(4, 2), (-1, 2))


def test_value_out_of_range_names_the_range():
    with pytest.raises(errors.ConfigError, match="fov: expected a value from 1 to 90, got 120"):
        errors.check_range("fov", 120, 1, 90)


def test_too_much_memory_names_the_dial():
    with pytest.raises(errors.SizeError, match=r"bake: needs 3\.0 GiB of memory, the limit is 1\.0 GiB; fewer texels"):
        errors.check_memory("bake", 3 * 2**30, 2**30, "fewer texels")


@pytest.mark.parametrize(("size", "text"), [(12, "12 B"), (1536, "1.5 KiB"), (3 * 2**40, "3.0 TiB")])
def test_human_size(size, text):
    assert errors.human_size(size) == text


def test_nearest_name_is_offered():
    assert errors.did_you_mean("ranks", ["rank", "storage"]) == "; did you mean 'rank'?"
    assert "known: rank, storage" in errors.did_you_mean("xyz", ["rank", "storage"])


@pytest.mark.errors
def test_values_that_are_not_finite_are_counted():
    errors.check_finite("x", torch.ones(3), 0, 1)
    with pytest.raises(errors.ShapeError, match=r"x: expected finite values, got nan at \(1, 0\) and 1 more of 6"):
        errors.check_finite("x", torch.tensor([[0.0, 1, 2], [float("nan"), 3, float("inf")]]))
    with pytest.raises(errors.ShapeError, match=r"x: expected finite values from 0 to 1, got 2$"):
        errors.check_finite("x", torch.tensor([0.0, 2]), 0, 1)
