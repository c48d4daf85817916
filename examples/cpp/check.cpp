// check EXPORT RECORD: plays what the Python controller saw (record.py) through this one, and compares step by step.
// Without onnxruntime's headers the network is the record's own actions: observations, clock, history and targets are compared all the same.
#include <chrono>
#include <cstdio>
#include <sstream>

#include "policy.hpp"
#if __has_include(<onnxruntime_cxx_api.h>)
#include "network.hpp"
#define WITH_NETWORK 1
#else
#define WITH_NETWORK 0
#endif

using namespace legged_mw;

namespace {

struct Recorded : Network {  // the actions that Python's network gave
  std::vector<float> actions;
  const std::vector<float>& act(const std::vector<float>&) override { return actions; }
};

template <class Found>
void compare(const char* what, const Found& found, const std::vector<double>& wanted, std::map<std::string, double>& worst) {
  if (found.size() != wanted.size())
    throw std::runtime_error("the record is of another export: its " + std::string(what) + " has " + std::to_string(wanted.size()) +
                             " values, this one " + std::to_string(found.size()));
  for (size_t i = 0; i < wanted.size(); ++i) {
    const double off = std::abs(static_cast<double>(found[i]) - wanted[i]);
    if (!(off <= worst[what])) worst[what] = std::isnan(off) ? INFINITY : off;
  }
}

int check(const std::string& folder, const std::string& path) {
  const Contract contract(folder);
  Recorded recorded;
#if WITH_NETWORK
  OnnxNetwork network(folder, contract);
#else
  Recorded& network = recorded;
  std::puts("onnxruntime_cxx_api.h was not found: the actions are the record's own");
#endif
  Controller controller(contract, network);
  std::ifstream file(path);
  std::string line, name;
  if (!std::getline(file, line)) throw std::runtime_error("cannot read " + path + "; record.py writes one");
  std::vector<std::pair<std::string, size_t>> columns;  // "NAME SIZE ..."
  std::istringstream head(line);
  for (size_t size; head >> name >> size;) columns.emplace_back(name, size);
  std::map<std::string, double> worst;
  std::vector<double> times;  // [ms] of each step
  while (std::getline(file, line)) {
    const char* at = line.c_str();
    Measurement row;
    for (const auto& [column, size] : columns)
      for (size_t i = 0; i < size; ++i) {
        char* end = nullptr;
        row[column].push_back(std::strtod(at, &end));
        if (end == at) throw std::runtime_error(path + ": a row is cut off");
        at = end;
      }
    recorded.actions.assign(row.at("action").begin(), row.at("action").end());
    if (row.at("fresh")[0] != 0) controller.reset();
    const auto began = std::chrono::steady_clock::now();
    controller.act(row, row.at("command"));
    times.push_back(std::chrono::duration<double, std::milli>(std::chrono::steady_clock::now() - began).count());
    compare("observation", controller.observation, row.at("observation"), worst);
    compare("action", controller.actions, row.at("action"), worst);
    compare("wanted", controller.wanted, row.at("wanted"), worst);
    compare("target", controller.targets, row.at("target"), worst);
  }
  if (times.empty()) throw std::runtime_error(path + " holds no step");
  std::sort(times.begin(), times.end());
  std::printf("%s: %zu steps; a step takes median %.3f, p99 %.3f, worst %.3f ms\n", contract.task.c_str(), times.size(),
              times[times.size() / 2], times[times.size() * 99 / 100], times.back());
  bool fits = true;
  for (const auto& [what, error] : worst) {
    std::printf("%s: off by %.2g at most\n", what.c_str(), error);
    fits = fits && error <= 1e-5;
  }
  std::puts(fits ? "as Python's controller" : "NOT as Python's controller: off by more than 1e-5");
  return fits ? 0 : 1;
}

}  // namespace

int main(int count, char** texts) {
  try {
    if (count != 3) throw std::runtime_error("check EXPORT RECORD: the folder of an export, and what record.py wrote");
    return check(texts[1], texts[2]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "check: %s\n", error.what());
    return 2;
  }
}
