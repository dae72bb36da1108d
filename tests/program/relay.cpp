// Gives back what it gets, and counts it from where `from` says. `fail` and `crash` name the count at which it does so.
#include "dataflow.hpp"

#include <cstdlib>

class Relay : public dataflow::Operator {
  public:
    std::vector<dataflow::Message> setup(const dataflow::Parameters &parameters) override {
        count_ = from_ = std::stoll(parameters.at("first"));
        fail_ = std::stoll(parameters.at("fail"));
        crash_ = std::stoll(parameters.at("crash"));
        return {};
    }

    std::vector<dataflow::Message> process(std::int64_t stamp, const std::vector<dataflow::Message> &inputs) override {
        std::cerr << "firing " << count_ << std::endl;
        if (count_ == fail_) throw std::runtime_error("no such count: " + std::to_string(count_));
        if (count_ == crash_) std::abort();
        auto back = inputs.at(0);
        back.port = "back";
        return {back, {"count", "Number", stamp, {static_cast<double>(count_++), std::string("messages")}, {}}};
    }

    std::vector<dataflow::Message> finish() override {
        return {{"total", "Number", 1'000'000, {static_cast<double>(count_ - from_), std::string()}, {}}};
    }

    void reset(const std::string &input) override { count_ = input == "message" ? from_ : -1; }
    void parameter(const std::string &name, const std::string &value) override {
        if (name == "fail") fail_ = std::stoll(value);
    }
    std::optional<dataflow::Bytes> snapshot() override { return dataflow::Bytes{static_cast<std::uint8_t>(count_)}; }
    bool restore(const dataflow::Bytes &state) override {
        count_ = state.at(0);
        return true;
    }

  private:
    std::int64_t count_ = 0, from_ = 0, fail_ = -1, crash_ = -1;
};

int main() {
    Relay relay;
    return dataflow::run(relay);
}
