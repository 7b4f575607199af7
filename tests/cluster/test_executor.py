"""The parts of Slurm's executor that this program replaces are those of the installed version."""

from __future__ import annotations

import inspect

from stages.workflow.internals import JOB_NAME
from tests.tools import need_package


def test_the_executor_for_slurm_has_what_is_replaced() -> None:
    need_package("snakemake_executor_plugin_slurm")
    import snakemake_executor_plugin_slurm as slurm

    executor = slurm.Executor
    assert inspect.isasyncgenfunction(executor.check_active_jobs)
    assert [*inspect.signature(executor.check_active_jobs).parameters] == ["self", "active_jobs"]
    assert isinstance(executor.next_seconds_between_status_checks, property)
    for report in (executor.report_job_success, executor.report_job_error):
        assert [*inspect.signature(report).parameters][:2] == ["self", "job_info"]
    assert "self.run_uuid = str(uuid.uuid4())" in inspect.getsource(executor)
    run = "12345678-1234-1234-1234-1234567890ab"
    assert JOB_NAME.fullmatch(run) and JOB_NAME.fullmatch(f"splatmake_{run}")
