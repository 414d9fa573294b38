// The joint estimate of a hexapod, as dumped by benchmarks/solver.py, solved by Ceres with
// automatic derivatives; README.md has the file's format and what is asked.

#include <ceres/ceres.h>
#include <ceres/rotation.h>
#include <glog/logging.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <map>
#include <memory>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

// Arrays by name, all in float64; the text line before each names it and its shape.
struct Dump {
  std::map<std::string, std::vector<double>> arrays;

  explicit Dump(const char* path) {
    std::ifstream file(path, std::ios::binary);
    std::string line;
    if (!std::getline(file, line) || line != "pkmcal least squares 1")
      throw std::runtime_error("no dump of benchmarks/solver.py");
    while (std::getline(file, line)) {
      std::istringstream words(line);
      std::string name;
      std::size_t size = 1, side;
      words >> name;
      while (words >> side) size *= side;
      std::vector<double> numbers(size);
      file.read(reinterpret_cast<char*>(numbers.data()), std::streamsize(8 * size));
      if (!file) throw std::runtime_error("the dump ends within " + name);
      arrays[name] = std::move(numbers);
    }
  }

  const std::vector<double>& operator[](const char* name) const { return arrays.at(name); }
};

using Pose = std::array<double, 6>;  // rotation vector, then translation
// Of a leg: base joint and platform joint, 3 numbers each, and the radii of its two tubes.
using Leg = std::array<double, 8>;
using Rod = std::array<double, 2>;  // offset, scale

Pose pose_of(const double* matrix) {  // 4x4, row by row
  Pose out;
  const double rot[9] = {matrix[0], matrix[4], matrix[8], matrix[1], matrix[5],
                         matrix[9], matrix[2], matrix[6], matrix[10]};  // column by column
  ceres::RotationMatrixToAngleAxis(rot, out.data());
  out[3] = matrix[3], out[4] = matrix[7], out[5] = matrix[11];
  return out;
}

template <typename T>
void apply(const T* pose, const T* point, T* out) {
  ceres::AngleAxisRotatePoint(pose, point, out);
  for (int k = 0; k < 3; ++k) out[k] += pose[3 + k];
}

// One edge in a photograph: of what tube, on which side, and where it was found.
struct Edge {
  int tube;
  double sign;          // of its side
  double basis[3][2];   // of the tangent plane of the measured normal
  double whiten[2][2];  // inverse of the Cholesky factor of its covariance
  double shift[2];      // change of the measured normal by a pixel of the camera's edge shift
};

// Edges of one leg in one photograph, which share its line: all of them, or one alone.
struct View {
  std::vector<Edge> edges;

  template <typename T>
  bool operator()(const T* platform, const T* camera, const T* leg, const T* shift,
                  T* residuals) const {
    T b_base[3], a[3], b[3], u[3], m[3];
    apply(platform, leg + 3, b_base);
    apply(camera, leg, a);
    apply(camera, b_base, b);
    for (int k = 0; k < 3; ++k) u[k] = b[k] - a[k];
    const T inverse = 1.0 / sqrt(ceres::DotProduct(u, u));
    for (auto& x : u) x *= inverse;
    ceres::CrossProduct(a, u, m);
    const T distance = sqrt(ceres::DotProduct(m, m));
    for (auto& x : m) x /= distance;
    T across[3];
    ceres::CrossProduct(u, m, across);
    for (const Edge& edge : edges) {
      const T sine = leg[6 + edge.tube] / distance;
      if (!(sine < 1.0)) return false;  // the camera is within the tube
      const T cosine = edge.sign * sqrt(1.0 - sine * sine);
      T error[2] = {edge.shift[0] * *shift, edge.shift[1] * *shift};
      for (int k = 0; k < 3; ++k) {
        const T n = cosine * m[k] - sine * across[k];
        for (int i = 0; i < 2; ++i) error[i] += edge.basis[k][i] * n;
      }
      for (int i = 0; i < 2; ++i)
        *residuals++ = edge.whiten[i][0] * error[0] + edge.whiten[i][1] * error[1];
    }
    return true;
  }
};

// |B - A| = scale reading + offset, over the reading's noise.
struct Closure {
  double reading, noise;

  template <typename T>
  bool operator()(const T* platform, const T* leg, const T* rod, T* residual) const {
    T b[3];
    apply(platform, leg + 3, b);
    for (int k = 0; k < 3; ++k) b[k] -= leg[k];
    *residual = (sqrt(ceres::DotProduct(b, b)) - rod[1] * reading - rod[0]) / noise;
    return true;
  }
};

// What the drawing says of numbers that stand in one block.
template <int N>
struct Drawn {
  std::array<double, N> value, sigma;

  template <typename T>
  bool operator()(const T* x, T* residuals) const {
    for (int k = 0; k < N; ++k) residuals[k] = (x[k] - value[k]) / sigma[k];
    return true;
  }
};

template <int N>
std::array<double, N> numbers_at(const std::vector<double>& from, std::size_t place) {
  std::array<double, N> out;
  std::copy_n(from.begin() + long(N * place), N, out.begin());
  return out;
}

struct State {
  std::vector<Pose> platforms, cameras;
  std::vector<Leg> legs;
  std::vector<Rod> rods;
  std::vector<double> shifts;

  explicit State(const Dump& dump) {
    for (std::size_t k = 0; k < dump["T_base_platform"].size(); k += 16)
      platforms.push_back(pose_of(&dump["T_base_platform"][k]));
    for (std::size_t k = 0; k < dump["T_camera_base"].size(); k += 16)
      cameras.push_back(pose_of(&dump["T_camera_base"][k]));
    for (std::size_t k = 0; k < dump["legs"].size() / 8; ++k) {
      legs.push_back(numbers_at<8>(dump["legs"], k));
      rods.push_back(numbers_at<2>(dump["rods"], k));
    }
    shifts = dump["shifts"];
  }
};

void add_edges(const Dump& dump, bool together, State& state, ceres::Problem& problem) {
  // index: configuration, station, leg, tube, side, camera
  const auto &index = dump["edge_index"], &basis = dump["edge_basis"],
             &whiten = dump["edge_whiten"], &shift = dump["edge_shift"];
  std::map<std::array<int, 5>, std::vector<Edge>> views;
  for (std::size_t k = 0; k < index.size() / 6; ++k) {
    std::array<int, 6> at;
    std::transform(&index[6 * k], &index[6 * k] + 6, at.begin(), [](double x) { return int(x); });
    Edge edge{at[3], at[4] ? -1.0 : 1.0, {}, {}, {shift[2 * k], shift[2 * k + 1]}};
    for (int i = 0; i < 6; ++i) edge.basis[i / 2][i % 2] = basis[6 * k + std::size_t(i)];
    for (int i = 0; i < 4; ++i) edge.whiten[i / 2][i % 2] = whiten[4 * k + std::size_t(i)];
    views[{at[0], at[1], at[2], at[5], together ? 0 : int(k)}].push_back(edge);
  }
  for (auto& [at, edges] : views) {
    const int rows = int(2 * edges.size());
    using Cost = ceres::AutoDiffCostFunction<View, ceres::DYNAMIC, 6, 6, 8, 1>;
    problem.AddResidualBlock(
        new Cost(new View{std::move(edges)}, rows), nullptr,
        state.platforms[std::size_t(at[0])].data(), state.cameras[std::size_t(at[1])].data(),
        state.legs[std::size_t(at[2])].data(), &state.shifts[std::size_t(at[3])]);
  }
}

void add_rest(const Dump& dump, State& state, ceres::Problem& problem) {
  const auto &readings = dump["readings"], &tolerances = dump["leg_tolerances"];
  const std::size_t n = state.legs.size();
  for (std::size_t k = 0; k < state.platforms.size(); ++k)
    for (std::size_t j = 0; j < n; ++j)
      problem.AddResidualBlock(
          new ceres::AutoDiffCostFunction<Closure, 1, 6, 8, 2>(
              new Closure{readings[n * k + j], dump["reading_noise"][0]}),
          nullptr, state.platforms[k].data(), state.legs[j].data(), state.rods[j].data());
  for (std::size_t j = 0; j < n; ++j) {
    problem.AddResidualBlock(
        new ceres::AutoDiffCostFunction<Drawn<8>, 8, 8>(new Drawn<8>{
            numbers_at<8>(dump["drawn_legs"], j), numbers_at<8>(tolerances, j)}),
        nullptr, state.legs[j].data());
    problem.AddResidualBlock(
        new ceres::AutoDiffCostFunction<Drawn<2>, 2, 2>(new Drawn<2>{
            numbers_at<2>(dump["drawn_rods"], j), numbers_at<2>(dump["rod_tolerances"], j)}),
        nullptr, state.rods[j].data());
  }
  for (double& shift : state.shifts)
    problem.AddResidualBlock(new ceres::AutoDiffCostFunction<Drawn<1>, 1, 1>(
                                 new Drawn<1>{{0.0}, {dump["shift_sigma"][0]}}),
                             nullptr, &shift);
}

// The greatest memory of this program alone; getrusage counts that of who started it, too.
double most_megabytes() {
  std::ifstream status("/proc/self/status");
  for (std::string line; std::getline(status, line);)
    if (line.rfind("VmHWM:", 0) == 0) return std::atof(line.c_str() + 6) / 1024;
  return 0.0;
}

double processor_seconds() {
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return double(t.tv_sec) + 1e-9 * double(t.tv_nsec);
}

}  // namespace

int main(int argc, char** argv) {
  google::InitGoogleLogging(argv[0]);
  if (argc != 5) {
    std::fprintf(stderr, "usage: solve DUMP RADIUS edge|view REPEATS\n");
    return 2;
  }
  const Dump dump(argv[1]);
  const bool together = std::string(argv[3]) == "view";
  ceres::Solver::Options options;
  options.linear_solver_type = ceres::DENSE_SCHUR;
  options.initial_trust_region_radius = std::atof(argv[2]);
  options.max_trust_region_radius = 1e16;
  options.max_num_iterations = 200;
  options.function_tolerance = 1e-9;  // to which costs are compared
  options.gradient_tolerance = 1e-16;
  options.num_threads = 1;
  options.logging_type = ceres::SILENT;

  double best = 1e300, cost = 0.0;
  std::size_t steps = 0;
  for (int k = 0; k < std::atoi(argv[4]); ++k) {
    State state(dump);
    ceres::Problem problem;
    add_edges(dump, together, state, problem);
    add_rest(dump, state, problem);
    auto ordering = std::make_shared<ceres::ParameterBlockOrdering>();
    std::vector<double*> blocks;
    problem.GetParameterBlocks(&blocks);
    for (double* block : blocks) ordering->AddElementToGroup(block, 1);
    for (auto& pose : state.platforms) ordering->AddElementToGroup(pose.data(), 0);
    options.linear_solver_ordering = ordering;
    ceres::Solver::Summary summary;
    const double begin = processor_seconds();
    ceres::Solve(options, &problem, &summary);
    best = std::min(best, processor_seconds() - begin);
    if (!summary.IsSolutionUsable()) {
      std::fprintf(stderr, "%s\n", summary.message.c_str());
      return 1;
    }
    cost = 2 * summary.final_cost;
    steps = summary.iterations.size() - 1;
  }
  std::printf("{\"cpu\": %.6f, \"steps\": %zu, \"answer\": %.17g, \"MB\": %.1f}\n", best, steps, cost,
              most_megabytes());
}
