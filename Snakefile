# The DAG: one rule per stage, made from the declarations in stages/. The plan decides which stages a
# scene needs before any job starts.

import os
import sys

sys.path.insert(0, workflow.basedir)

from stages.workflow.display import show_run
from stages.workflow.project import SnakemakeProject, check_config

display = show_run(workflow)
if os.path.exists("config/config.yaml"):
    check_config("config/config.yaml")

    configfile: "config/config.yaml"


project = SnakemakeProject(config, workflow, display)
RUN = (
    "exec python -m stages {rule} --out {params.out:q} --key {params.key:q}"
    " --input {params.inputs:q} --publish {params.publish:q} --threads {threads}"
    " --memory-mb {resources.mem_mb} --log {log:q}"
)


onstart:
    project.before_jobs()


onsuccess:
    project.after_success()


onerror:
    project.after_failure()


wildcard_constraints:
    scene=r"[^/]+",
    job=r"[1-9][0-9]*",


localrules:
    accept,
    all,
    benchmark,
    plan,


report: project.packaged("pipeline/reporting/captions/workflow.rst")


# The runs' files themselves, too: Snakemake makes a deleted file again only if it is asked for.
rule all:
    input:
        "results/benchmark.csv",
        project.every_run,


# All scenes with all configurations and seeds. If some fail, after_failure() writes these files with
# the others.
rule benchmark:
    input:
        project.every_run,
    output:
        table=report(
            "results/benchmark.csv",
            caption=project.packaged("pipeline/reporting/captions/benchmark.rst"),
            category="Batch",
        ),
        data="results/benchmark.json",
        page=report(
            "results/index.html",
            caption=project.packaged("pipeline/reporting/captions/index.rst"),
            category="Batch",
        ),
    params:
        outcomes=project.outcomes,
    shell:
        "python -m stages.workflow.batch --results results --outcomes {params.outcomes:q}"


rule plan:
    output:
        plan="results/{scene}/plan.json",
        picture=report(
            "results/{scene}/plan.svg",
            caption=project.packaged("pipeline/reporting/captions/plan.rst"),
            category="{scene}",
        ),
    log:
        "results/{scene}/logs/plan.log",
    params:
        plan=project.plan,
    shell:
        "python -m stages.workflow.plan --out {output.plan:q} --picture {output.picture:q}"
        " --plan {params.plan:q} --log {log:q}"


# Whether a run's result is good enough. It fails, with the reasons, if it is not.
rule accept:
    input:
        metrics="results/{scene}/metrics.json",
    output:
        accepted="results/{scene}/accepted.json",
    log:
        "results/{scene}/logs/accept.log",
    params:
        criteria=project.acceptance,
    shell:
        "python -m stages.workflow.accept --out {output.accepted:q}"
        " --criteria {params.criteria:q} --log {log:q}"


# One rule per stage: inputs, key and outputs follow from its declaration.
for spec in project.stages:

    rule:
        name:
            spec.name
        input:
            unpack(project.inputs(spec)),
        output:
            **{
                f"published_{number}": report(
                    f"results/{{scene}}/{file}",
                    caption=project.packaged(caption),
                    category="{scene}",
                )
                for number, (file, caption) in enumerate(spec.publishes.items())
            },
            stage=f"results/{{scene}}/{project.folder(spec)}/stage.json",
        log:
            f"results/{{scene}}/logs/{project.folder(spec)}.log",
        group:
            project.group(spec)
        threads: project.threads(spec)
        resources:
            mem_mb=project.memory_mb(spec),
            runtime=project.minutes(spec),
            gpu=project.gpus(spec),
        params:
            out=subpath(output.stage, parent=True),
            key=project.key(spec),
            inputs=project.folders(spec),
            publish=project.published(spec),
        shell:
            RUN
