// The network of an export in onnxruntime, on one thread. After the constructor it allocates nothing of its own.
#pragma once

#include <onnxruntime_cxx_api.h>

#include "policy.hpp"

namespace legged_mw {

class OnnxNetwork : public Network {
 public:
  OnnxNetwork(const std::string& folder, const Contract& contract)
      : session_(env_, (folder + "/" + contract.file).c_str(), options()), actions_(contract.joints.size()), observation_(contract.size()) {
    add(contract.input, contract.output, {1, static_cast<int64_t>(observation_.size())}, observation_,
        {1, static_cast<int64_t>(actions_.size())}, actions_);
    if (contract.memory_shape.empty()) return;
    std::vector<int64_t> shape{1};
    shape.insert(shape.end(), contract.memory_shape.begin(), contract.memory_shape.end());
    memory_.resize(static_cast<size_t>(shape[1] * shape[2])), next_memory_.resize(memory_.size());
    add(contract.memory_input, contract.memory_output, shape, memory_, shape, next_memory_);
  }
  const std::vector<float>& act(const std::vector<float>& observation) override {
    std::copy(observation.begin(), observation.end(), observation_.begin());
    session_.Run(Ort::RunOptions{nullptr}, in_names_.data(), in_.data(), in_.size(), out_names_.data(), out_.data(), out_.size());
    std::copy(next_memory_.begin(), next_memory_.end(), memory_.begin());
    return actions_;
  }
  void reset() override { std::fill(memory_.begin(), memory_.end(), 0.0f); }

 private:
  static Ort::SessionOptions options() {
    Ort::SessionOptions options;
    options.SetIntraOpNumThreads(1).SetInterOpNumThreads(1);  // a network this small loses by a second
    return options;
  }
  // An input and an output of the network, each a tensor over a buffer of ours. A further output, an estimate, is not asked for.
  void add(const std::string& in, const std::string& out, const std::vector<int64_t>& in_shape, std::vector<float>& from,
           const std::vector<int64_t>& out_shape, std::vector<float>& to) {
    const Ort::MemoryInfo cpu = Ort::MemoryInfo::CreateCpu(OrtArenaAllocator, OrtMemTypeDefault);
    in_.push_back(Ort::Value::CreateTensor<float>(cpu, from.data(), from.size(), in_shape.data(), in_shape.size()));
    out_.push_back(Ort::Value::CreateTensor<float>(cpu, to.data(), to.size(), out_shape.data(), out_shape.size()));
    in_names_.push_back(in.c_str()), out_names_.push_back(out.c_str());
  }

  Ort::Env env_{ORT_LOGGING_LEVEL_FATAL};
  Ort::Session session_;
  std::vector<float> actions_, observation_, memory_, next_memory_;
  std::vector<const char*> in_names_, out_names_;  // the contract's, which outlives this
  std::vector<Ort::Value> in_, out_;
};

}  // namespace legged_mw
