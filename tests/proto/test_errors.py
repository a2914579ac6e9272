import pytest

from vergence_proto.errors import (
    ERROR_CLASSES,
    DepthError,
    ErrorCode,
    ModelFailed,
    error_from_wire,
)


def test_every_error_code_has_one_class() -> None:
    assert set(ERROR_CLASSES) == set(ErrorCode)
    assert {error.code for error in ERROR_CLASSES.values()} == set(ErrorCode)
    assert len(DepthError.__subclasses__()) == len(ErrorCode)


@pytest.mark.parametrize("code", ErrorCode)
def test_the_wire_brings_back_the_class_that_was_raised(code: ErrorCode) -> None:
    raised = ERROR_CLASSES[code]("too much", retry_after_s=0.5)
    back = error_from_wire(raised.code, str(raised), raised.retry_after_s)
    assert type(back) is type(raised)
    assert (str(back), back.retry_after_s) == ("too much", 0.5)


def test_a_reason_from_a_newer_server_is_reported_by_name() -> None:
    error = error_from_wire("LENS_COVERED", "take the cap off")
    assert type(error) is ModelFailed
    assert str(error) == "LENS_COVERED: take the cap off"
