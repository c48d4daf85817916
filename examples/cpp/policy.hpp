// An exported policy around its network: observations from a measurement in the contract's order, joint targets from actions.
// It does what legged_mw/deploy/controller.py does, and knows no robot, no clock and no limits.
#pragma once

#include <algorithm>
#include <cmath>
#include <map>
#include <string>
#include <vector>

#include "yaml.hpp"

namespace legged_mw {

// What one robot measures, by the names of legged_mw/deploy/robot.py: lin_vel, ang_vel, gravity, joint_pos, joint_vel, joint_torque,
// acceleration, foot_contact. Joints are in the contract's order. A row with sensors of its own goes by the row's name.
using Measurement = std::map<std::string, std::vector<double>>;

struct Network {
  virtual ~Network() = default;
  virtual const std::vector<float>& act(const std::vector<float>& observation) = 0;  // actions, not clipped yet
  virtual void reset() {}                                                            // forget, if it remembers
};

struct Row {
  std::string name, measured;
  size_t size, history;
  std::vector<double> scale;  // one a value
};

struct Command {
  std::string name;
  double lowest, highest, rest;
};

struct Contract {
  explicit Contract(const std::string& folder) : Contract(YamlReader(folder + "/policy.yaml").read()) {}
  explicit Contract(const Yaml& top) {
    const int format = static_cast<int>(top["format"].number());
    if (format >= 2 && format < 5)
      top["format"].fail("format " + std::to_string(format) + " does not say within which range targets are held: export the policy again");
    if (format != 5) top["format"].fail("format " + std::to_string(format) + " is not one that this program reads (5)");
    if (const Yaml* motion = top.find("motion")) motion->fail("the policy follows a motion, which this program cannot");
    task = top["task"].text, period = top["period"].number();
    const Yaml &network = top["network"], &action = top["action"];
    file = network["file"].text, input = network["input"].text, output = network["output"].text;
    if (const Yaml* memory = network.find("memory")) {
      memory_input = (*memory)["input"].text, memory_output = (*memory)["output"].text;
      for (double size : (*memory)["shape"].numbers()) memory_shape.push_back(static_cast<int64_t>(size));
    }
    for (const Yaml& joint : top["joints"].items()) joints.push_back(joint.text);
    lowest = values(action, "lowest"), highest = values(action, "highest");
    default_pose = values(top, "default_pose"), stiffness = values(top, "stiffness"), damping = values(top, "damping");
    origin = action["origin"].text, action_scale = spread(action["scale"], joints.size()), clip = action["clip"].number();
    if (origin != "default" && origin != "joints" && origin != "targets" && origin != "torque")
      action["origin"].fail("no origin '" + origin + "'; there are: default, joints, targets, torque");
    for (const Yaml& each : top["commands"].items())
      commands.push_back({each["name"].text, each["lowest"].number(), each["highest"].number(), each["default"].number()});
    for (const Yaml& each : top["observation"].items()) read_row(each);
    if (const Yaml* gait = top.find("gait")) {
      gait_period = (*gait)["period"].number(), gait_offsets = (*gait)["offsets"].numbers(), min_command = (*gait)["min_command"].number();
    }
  }
  size_t size() const {  // values of an observation
    size_t sum = 0;
    for (const Row& row : rows) sum += row.size * row.history;
    return sum;
  }
  size_t command(const std::string& name) const {
    for (size_t i = 0; i < commands.size(); ++i)
      if (commands[i].name == name) return i;
    throw std::runtime_error("policy.yaml: the gait clock needs a command '" + name + "'");
  }

  std::string task, file, input, output, memory_input, memory_output, origin;
  std::vector<int64_t> memory_shape;  // states, values each; none of a network without a memory
  double period = 0, clip = 0, gait_period = 0, min_command = 0;  // [s], [-], [s], norm of (vx, vy, yaw rate)
  std::vector<std::string> joints;
  std::vector<double> default_pose, stiffness, damping, action_scale, gait_offsets;  // [rad], [N m/rad], [N m s/rad], ...
  std::vector<double> lowest, highest;  // [rad] of what a servo is told; +-1e6: anything
  std::vector<Command> commands;
  std::vector<Row> rows;

 private:
  std::vector<double> values(const Yaml& top, const std::string& key) const {
    const std::vector<double> found = top[key].numbers();
    if (found.size() != joints.size()) top[key].fail("'" + key + "' must have one number a joint");
    return found;
  }
  static std::vector<double> spread(const Yaml& scale, size_t size) {  // one number stands for all
    const std::vector<double> found = scale.list.empty() ? std::vector<double>(size, scale.number()) : scale.numbers();
    if (found.size() != size) scale.fail("the scale must be one number, or " + std::to_string(size));
    return found;
  }
  void read_row(const Yaml& each) {
    const size_t size = static_cast<size_t>(each["size"].number());
    const Yaml* history = each.find("history");
    const std::string measured = each["measured"].text, name = each["name"].text;
    if (measured.empty()) each.fail("nothing says how row '" + name + "' is measured, so it cannot be deployed");
    const size_t frames = history ? static_cast<size_t>(history->number()) : 1;
    rows.push_back({name, measured == "sensors" || measured == "height_scan" ? name : measured, size, frames, spread(each["scale"], size)});
  }
};

class Controller {
 public:
  Controller(const Contract& contract, Network& network) : contract_(contract), network_(network) {
    for (const char* name : {"lin_vel_x", "lin_vel_y", "ang_vel_yaw"})
      if (!contract.gait_offsets.empty()) velocity_.push_back(contract.command(name));
    for (const Row& row : contract.rows) frames_.emplace_back(row.history * row.size);
    reset();
  }
  void reset() {  // the robot begins again: nothing is remembered
    network_.reset();
    fresh_ = true, running_ = false, phase_ = 0;
    actions.assign(contract_.joints.size(), 0.0f);
    wanted = targets = contract_.default_pose;
  }
  // Joint targets [rad], or torques [N m] where the origin is "torque", for the next period, within the contract's range. Commands are
  // in the contract's order.
  const std::vector<double>& act(const Measurement& measured, const std::vector<double>& command) {
    observe(measured, command);
    const std::vector<float>& raw = network_.act(observation);
    for (size_t i = 0; i < actions.size(); ++i) {
      const float clip = static_cast<float>(contract_.clip);
      actions[i] = std::isfinite(raw.at(i)) ? std::clamp(raw[i], -clip, clip) : NAN;  // not finite: a fault to stop at, not a wish
      const double origin = contract_.origin == "default"  ? contract_.default_pose[i]
                            : contract_.origin == "joints" ? measured.at("joint_pos")[i]
                            : contract_.origin == "targets" ? wanted[i]
                                                            : 0.0;
      wanted[i] = origin + contract_.action_scale[i] * static_cast<double>(actions[i]);
      targets[i] = std::min(std::max(wanted[i], contract_.lowest[i]), contract_.highest[i]);  // NaN stays
    }
    fresh_ = false;
    return targets;
  }

  std::vector<float> observation, actions;  // of the last step; actions are clipped
  std::vector<double> wanted, targets;      // likewise: the policy's own, to be judged and logged; as held within the range

 private:
  void observe(const Measurement& measured, const std::vector<double>& command) {
    observation.clear();
    tick(command);
    for (size_t r = 0; r < contract_.rows.size(); ++r) {
      const Row& row = contract_.rows[r];
      const std::vector<double> values = value(row, measured, command);
      if (values.size() != row.size)
        throw std::runtime_error("row '" + row.name + "' has " + std::to_string(row.size) + " values; " + row.measured + " has " +
                                 std::to_string(values.size()));
      std::vector<float>& frames = frames_[r];  // the oldest first; at the start all are the first one
      for (size_t frame = fresh_ ? 0 : row.history - 1; frame < row.history; ++frame) {
        if (!fresh_) std::rotate(frames.begin(), frames.begin() + static_cast<long>(row.size), frames.end());
        for (size_t i = 0; i < row.size; ++i) frames[frame * row.size + i] = static_cast<float>(values[i] * row.scale[i]);
      }
      observation.insert(observation.end(), frames.begin(), frames.end());
    }
  }
  std::vector<double> value(const Row& row, const Measurement& measured, const std::vector<double>& command) const {
    if (row.measured == "command") return command;
    if (row.measured == "last_action") return {actions.begin(), actions.end()};
    if (row.measured == "gait_clock") return clock();
    const bool offset = row.measured == "joint_offset";
    const auto found = measured.find(offset ? "joint_pos" : row.measured);
    if (found == measured.end()) throw std::runtime_error("the robot does not measure '" + row.measured + "' of row '" + row.name + "'");
    std::vector<double> values = found->second;
    for (size_t i = 0; offset && i < values.size(); ++i) values[i] -= contract_.default_pose[i];
    return values;
  }
  void tick(const std::vector<double>& command) {  // the gait clock: at rest while told to stand, from 0 when told to move
    double square = 0;
    for (size_t i : velocity_) square += command[i] * command[i];
    const bool runs = square > contract_.min_command * contract_.min_command;
    const bool goes_on = runs && running_ && !fresh_;
    phase_ = goes_on ? std::fmod(phase_ + contract_.period / contract_.gait_period, 1.0) : 0.0;
    running_ = runs;
  }
  std::vector<double> clock() const {  // sine of each foot's phase, then cosine of each
    std::vector<double> values;
    for (auto* wave : {static_cast<double (*)(double)>(std::sin), static_cast<double (*)(double)>(std::cos)})
      for (double offset : contract_.gait_offsets) values.push_back(running_ ? wave(2.0 * M_PI * (phase_ + offset)) : 0.0);
    return values;
  }

  const Contract& contract_;
  Network& network_;
  std::vector<std::vector<float>> frames_;  // of each row
  std::vector<size_t> velocity_;            // places of vx, vy, yaw rate among the commands, where there is a clock
  double phase_ = 0;
  bool fresh_ = true, running_ = false;
};

}  // namespace legged_mw
