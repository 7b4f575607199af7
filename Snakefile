# The DAG and nothing else: a rule a stage. What a stage reads and when it runs again stands in
# stages/wiring.py, what a scene needs in pipeline/scene/plan.py, what a stage does in stages/.

import os
import sys

sys.path.insert(0, workflow.basedir)

from stages.project import SnakemakeProject

if os.path.exists("config/config.yaml"):

    configfile: "config/config.yaml"


project = SnakemakeProject(config, workflow.basedir)
THREADS = workflow.cores or 8
RUN = (
    "python -m stages.{rule} --out results/{wildcards.scene:q}/{rule} --key {params.key:q}"
    " --input {params.inputs:q} --publish {params.publish:q} --threads {threads} --log {log:q}"
)


onstart:
    # No limit on jobs started a second: Snakemake keeps to its own by looking for work once a second
    # for each job that has ended while others wait, a fifth of a core after eighty.
    workflow.scheduler.job_rate_limiter = None


onerror:
    project.after_failure()


wildcard_constraints:
    scene=r"[^/]+",


localrules:
    all,
    benchmark,
    plan,


report: "pipeline/reporting/captions/workflow.rst"


rule all:
    input:
        "results/benchmark.csv",


# All scenes under all configurations and seeds. When some fail, after_failure() writes these files
# with what there is.
rule benchmark:
    input:
        project.every_run,
    output:
        table=report(
            "results/benchmark.csv",
            caption="pipeline/reporting/captions/benchmark.rst",
            category="Batch",
        ),
        data="results/benchmark.json",
        page=report(
            "results/index.html",
            caption="pipeline/reporting/captions/index.rst",
            category="Batch",
        ),
    params:
        outcomes=project.outcomes,
    shell:
        "python -m stages.batch --results results --outcomes {params.outcomes:q}"


rule plan:
    output:
        plan="results/{scene}/plan.json",
        picture=report(
            "results/{scene}/plan.svg",
            caption="pipeline/reporting/captions/plan.rst",
            category="{scene}",
        ),
    params:
        plan=project.plan,
    shell:
        "python -m stages.plan --out {output.plan:q} --picture {output.picture:q}"
        " --plan {params.plan:q}"


rule inspect:
    output:
        "results/{scene}/inspect/stage.json",
    log:
        "results/{scene}/logs/inspect.log",
    threads: THREADS
    params:
        key=project.key("inspect"),
        inputs=[],
        publish=[],
    shell:
        RUN


rule decode:
    input:
        unpack(project.inputs("decode")),
    output:
        "results/{scene}/decode/stage.json",
    log:
        "results/{scene}/logs/decode.log",
    threads: THREADS
    resources:
        mem_mb=2000,
    params:
        key=project.key("decode"),
        inputs=project.folders("decode"),
        publish=[],
    shell:
        RUN


rule features:
    input:
        unpack(project.inputs("features")),
    output:
        "results/{scene}/features/stage.json",
    log:
        "results/{scene}/logs/features.log",
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        key=project.key("features"),
        inputs=project.folders("features"),
        publish=[],
    shell:
        RUN


rule matches:
    input:
        unpack(project.inputs("matches")),
    output:
        "results/{scene}/matches/stage.json",
    log:
        "results/{scene}/logs/matches.log",
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        key=project.key("matches"),
        inputs=project.folders("matches"),
        publish=[],
    shell:
        RUN


rule sfm:
    input:
        unpack(project.inputs("sfm")),
    output:
        "results/{scene}/sfm/stage.json",
    log:
        "results/{scene}/logs/sfm.log",
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        key=project.key("sfm"),
        inputs=project.folders("sfm"),
        publish=[],
    shell:
        RUN


rule refine:
    input:
        unpack(project.inputs("refine")),
    output:
        "results/{scene}/refine/stage.json",
    log:
        "results/{scene}/logs/refine.log",
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        key=project.key("refine"),
        inputs=project.folders("refine"),
        publish=[],
    shell:
        RUN


rule undistort:
    input:
        unpack(project.inputs("undistort")),
    output:
        "results/{scene}/undistort/stage.json",
    log:
        "results/{scene}/logs/undistort.log",
    threads: THREADS
    resources:
        mem_mb=2000,
    params:
        key=project.key("undistort"),
        inputs=project.folders("undistort"),
        publish=[],
    shell:
        RUN


rule init:
    input:
        unpack(project.inputs("init")),
    output:
        "results/{scene}/init/stage.json",
    log:
        "results/{scene}/logs/init.log",
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        key=project.key("init"),
        inputs=project.folders("init"),
        publish=[],
    shell:
        RUN


rule train:
    input:
        unpack(project.inputs("train")),
    output:
        "results/{scene}/train/stage.json",
    log:
        "results/{scene}/logs/train.log",
    threads: THREADS
    resources:
        mem_mb=project.training_memory,
    params:
        key=project.key("train"),
        inputs=project.folders("train"),
        publish=[],
    shell:
        RUN


rule evaluate:
    input:
        unpack(project.inputs("evaluate")),
    output:
        "results/{scene}/evaluate/stage.json",
    log:
        "results/{scene}/logs/evaluate.log",
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        key=project.key("evaluate"),
        inputs=project.folders("evaluate"),
        publish=[],
    shell:
        RUN


rule export:
    input:
        unpack(project.inputs("export")),
    output:
        "results/{scene}/export/stage.json",
    log:
        "results/{scene}/logs/export.log",
    threads: THREADS
    resources:
        mem_mb=2000,
    params:
        key=project.key("export"),
        inputs=project.folders("export"),
        publish=[],
    shell:
        RUN


rule report:
    input:
        unpack(project.inputs("report")),
        plan="results/{scene}/plan.json",
    output:
        stage="results/{scene}/report/stage.json",
        metrics=report(
            "results/{scene}/metrics.json",
            caption="pipeline/reporting/captions/metrics.rst",
            category="{scene}",
        ),
        page=report(
            "results/{scene}/report.html",
            caption="pipeline/reporting/captions/page.rst",
            category="{scene}",
        ),
    log:
        "results/{scene}/logs/report.log",
    threads: THREADS
    resources:
        mem_mb=2000,
    params:
        key=project.key("report"),
        inputs=project.folders("report"),
        publish=project.published("metrics.json", "report.html"),
    shell:
        RUN
