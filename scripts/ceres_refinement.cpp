// The same problem for Ceres: pixels and 3D points with latent points, autodiff, DENSE_SCHUR. Used by
// benchmark_refinement.py, which writes the problem and reads "seconds cost iterations" from standard output.
#include <ceres/ceres.h>
#include <ceres/rotation.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <limits>
#include <vector>

struct Pixel {  // eq. 2.3 over sigma_2D
  double u, v, fx, fy, cx, cy, sigma;
  template <typename T>
  bool operator()(const T* pose, const T* x, T* r) const {
    T p[3];
    ceres::AngleAxisRotatePoint(pose, x, p);
    const T z = p[2] + pose[5];
    r[0] = (T(u) - (fx * (p[0] + pose[3]) / z + cx)) / sigma;
    r[1] = (T(v) - (fy * (p[1] + pose[4]) / z + cy)) / sigma;
    return true;
  }
};

struct Measured {  // eq. 2.5 against the latent point, over sigma_3D
  double p[3], sigma;
  template <typename T>
  bool operator()(const T* pose, const T* x, T* r) const {
    T q[3];
    ceres::AngleAxisRotatePoint(pose, x, q);
    for (int i = 0; i < 3; ++i) r[i] = (T(p[i]) - (q[i] + pose[3 + i])) / sigma;
    return true;
  }
};

template <typename T>
std::vector<T> take(FILE* f, size_t n) {
  std::vector<T> out(n);
  if (fread(out.data(), sizeof(T), n, f) != n) {
    fprintf(stderr, "the problem file is too short\n");
    exit(2);
  }
  return out;
}

int main(int argc, char** argv) {
  if (argc != 5) {
    fprintf(stderr, "usage: %s problem.bin threads repeats tolerance\n", argv[0]);
    return 2;
  }
  FILE* f = fopen(argv[1], "rb");
  if (!f) return 2;
  const auto size = take<int64_t>(f, 4);  // cameras, points, pixels, measured points
  const auto sigma = take<double>(f, 2);
  const auto K = take<double>(f, 4 * size[0]);
  const auto pose_start = take<double>(f, 6 * size[0]);  // color from world: angle-axis, translation
  const auto x_start = take<double>(f, 3 * size[1]);
  const auto pixel_index = take<int64_t>(f, 2 * size[2]);
  const auto pixel = take<double>(f, 2 * size[2]);
  const auto xyz_index = take<int64_t>(f, 2 * size[3]);
  const auto xyz = take<double>(f, 3 * size[3]);
  fclose(f);

  double best = std::numeric_limits<double>::infinity(), cost = 0;
  size_t iterations = 0;
  for (int run = 0; run < atoi(argv[3]); ++run) {
    auto pose = pose_start;
    auto x = x_start;
    ceres::Problem problem;
    auto* order = new ceres::ParameterBlockOrdering;
    for (int64_t i = 0; i < size[2]; ++i) {
      const int64_t c = pixel_index[2 * i], h = pixel_index[2 * i + 1];
      problem.AddResidualBlock(
          new ceres::AutoDiffCostFunction<Pixel, 2, 6, 3>(new Pixel{pixel[2 * i], pixel[2 * i + 1], K[4 * c], K[4 * c + 1],
                                                                    K[4 * c + 2], K[4 * c + 3], sigma[0]}),
          nullptr, &pose[6 * c], &x[3 * h]);
    }
    for (int64_t i = 0; i < size[3]; ++i) {
      const int64_t c = xyz_index[2 * i], j = xyz_index[2 * i + 1];
      problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Measured, 3, 6, 3>(new Measured{
                                   {xyz[3 * i], xyz[3 * i + 1], xyz[3 * i + 2]}, sigma[1]}),
                               nullptr, &pose[6 * c], &x[3 * j]);
    }
    for (int64_t j = 0; j < size[1]; ++j) order->AddElementToGroup(&x[3 * j], 0);
    for (int64_t c = 0; c < size[0]; ++c) order->AddElementToGroup(&pose[6 * c], 1);
    problem.SetParameterBlockConstant(&pose[0]);
    ceres::Solver::Options options;
    options.linear_solver_type = ceres::DENSE_SCHUR;
    options.linear_solver_ordering.reset(order);
    options.num_threads = atoi(argv[2]);
    options.max_num_iterations = 200;
    options.function_tolerance = atof(argv[4]);
    options.gradient_tolerance = 1e-30;
    options.parameter_tolerance = 1e-30;
    options.logging_type = ceres::SILENT;
    ceres::Solver::Summary summary;
    const auto start = std::chrono::steady_clock::now();
    ceres::Solve(options, &problem, &summary);
    const double seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    if (seconds < best) best = seconds;
    cost = 2 * summary.final_cost;
    iterations = summary.iterations.size() - 1;
  }
  printf("%.9g %.17g %zu\n", best, cost, iterations);
  return 0;
}
