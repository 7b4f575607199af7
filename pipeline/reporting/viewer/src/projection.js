// Spark's projection, made that of splatmake's rasterizer (pipeline/render/cpu/csrc/constants.h):
// the Jacobian is evaluated within 1.3 half-fields of the axis, and a Gaussian is drawn wherever its
// centre is, if the ellipsoid of two standard deviations is in front of the camera. Quads cover no
// more than what shows.

const JACOBIAN_HALF_FIELDS = 1.3, MIN_DEPTH_SIGMAS = 2;

const CHANGES = [
  ["vec2 scaledRenderSize = renderSize * focalAdjustment;", shader => `
    if (viewCenter.z * viewCenter.z <= ${(MIN_DEPTH_SIGMAS ** 2).toFixed(1)} * cov3D[2][2]) return;
    ${shader}`],
  ["vec2 J2 = -(J1 * viewCenter.xy) * invZ;", () => `
        vec2 ndc = clamp(clipCenter.xy / clipCenter.w, ${-JACOBIAN_HALF_FIELDS}, ${JACOBIAN_HALF_FIELDS});
        vec2 offAxis = vec2(projectionMatrix[2][0], projectionMatrix[2][1]);
        vec2 focalNdc = vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
        vec2 slope = -(ndc + offAxis) / focalNdc;
        vec2 J2 = -J1 * slope;`],
  // Beyond these standard deviations, a Gaussian of this opacity is fainter than minAlpha.
  ["float scale1 = min(maxPixelRadius, adjustedStdDev * sqrt(eigen1));", shader => `
    if (rgba.a <= 1.0) adjustedStdDev = min(adjustedStdDev, sqrt(2.0 * log(rgba.a / minAlpha)));
    vSplatUv = position.xy * adjustedStdDev;
    ${shader}`],
];

export function projectAsRasterizer(spark) {
  spark.clipXY = Infinity;
  changeShader(spark, CHANGES);
}

// Changes the shader of a SparkRenderer, from each text to another; throws if Spark has another one.
export function changeShader(spark, changes) {
  for (const [text, changed] of changes) {
    if (!spark.material.vertexShader.includes(text)) throw new Error("another shader of Spark");
    spark.material.vertexShader = spark.material.vertexShader.replace(text, changed(text));
  }
}
