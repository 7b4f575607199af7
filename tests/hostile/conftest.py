"""The finished scene of the end-to-end tests."""

from tests.e2e.conftest import finished

__all__ = ["finished"]
