// The other side of dataflow.program.Program, in C++17: derive from dataflow::Operator and hand it to dataflow::run.
// The frames are specified in docs/other-languages.md, the envelopes in them in docs/wire-format.md. Little-endian machines.
// Standard output carries the replies: print to standard error, which is the operator's log.
#pragma once

#include <cstdint>
#include <cstring>
#include <exception>
#include <iostream>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

namespace dataflow {

using Bytes = std::vector<std::uint8_t>;
// A header field: absent, a bool, an integer, a float, a string or strings.
using Value = std::variant<std::monostate, bool, std::int64_t, double, std::string, std::vector<std::string>>;
// Parameters by name, each as JSON: 40, 0.5, true, "text".
using Parameters = std::map<std::string, std::string>;

// An array field: `dtype` as numpy writes it ("|u1", "<f4"), row-major, little-endian.
struct Array {
    std::string dtype;
    std::vector<std::size_t> shape;
    Bytes bytes;

    template <typename T> const T *as() const { return reinterpret_cast<const T *>(bytes.data()); }
    template <typename T> T *as() { return reinterpret_cast<T *>(bytes.data()); }
};

// A message: `fields` and `arrays` in the order of its schema (dataflow messages SCHEMA), `port` the input or output.
struct Message {
    std::string port, schema;
    std::int64_t stamp = 0;
    std::vector<Value> fields;
    std::vector<std::optional<Array>> arrays;
};

// What an operator defines. What it throws fails the call, with its text as the reason.
class Operator {
  public:
    virtual ~Operator() = default;
    // Called once; returns the messages of static outputs.
    virtual std::vector<Message> setup(const Parameters &) { return {}; }
    // Called for each firing; an input that takes no part has no message, a batch has several.
    virtual std::vector<Message> process(std::int64_t stamp, const std::vector<Message> &inputs) = 0;
    virtual std::vector<Message> finish() { return {}; }
    // The clock behind an input jumped back: begin anew.
    virtual void reset(const std::string &) {}
    // A tunable parameter was changed.
    virtual void parameter(const std::string &, const std::string &) {}
    // The state, such that restore() of it goes on alike; none: no state.
    virtual std::optional<Bytes> snapshot() { return std::nullopt; }
    virtual bool restore(const Bytes &) { return false; }
};

namespace detail {

inline void put(Bytes &to, const void *from, std::size_t size) {
    const auto *bytes = static_cast<const std::uint8_t *>(from);
    to.insert(to.end(), bytes, bytes + size);
}

template <typename T> void put(Bytes &to, T value) { put(to, &value, sizeof value); }

// msgpack: numbers are big-endian.
inline void put_big(Bytes &to, std::uint64_t value, int size) {
    while (size--) to.push_back(static_cast<std::uint8_t>(value >> (8 * size)));
}

inline void pack(Bytes &to, std::int64_t value) {
    to.push_back(0xd3);
    put_big(to, static_cast<std::uint64_t>(value), 8);
}

inline void pack(Bytes &to, const std::string &text) {
    to.push_back(0xdb);
    put_big(to, text.size(), 4);
    put(to, text.data(), text.size());
}

inline void pack_array(Bytes &to, std::size_t size) {
    to.push_back(0xdd);
    put_big(to, size, 4);
}

inline void pack(Bytes &to, const Value &value) {
    if (std::holds_alternative<std::monostate>(value)) {
        to.push_back(0xc0);
    } else if (const auto *flag = std::get_if<bool>(&value)) {
        to.push_back(*flag ? 0xc3 : 0xc2);
    } else if (const auto *integer = std::get_if<std::int64_t>(&value)) {
        pack(to, *integer);
    } else if (const auto *number = std::get_if<double>(&value)) {
        std::uint64_t bits;
        std::memcpy(&bits, number, sizeof bits);
        to.push_back(0xcb);
        put_big(to, bits, 8);
    } else if (const auto *text = std::get_if<std::string>(&value)) {
        pack(to, *text);
    } else {
        const auto &texts = std::get<std::vector<std::string>>(value);
        pack_array(to, texts.size());
        for (const auto &each : texts) pack(to, each);
    }
}

// Reads msgpack as far as envelopes have it.
class Reader {
  public:
    Reader(const Bytes &from, std::size_t begin, std::size_t end) : from_(from), at_(begin), end_(end) {
        if (begin > end || end > from.size()) throw std::runtime_error("an envelope ends early");
    }

    std::size_t array() {
        const auto code = big(1);
        if (code >= 0x90 && code <= 0x9f) return code & 0x0f;
        if (code == 0xdc) return big(2);
        if (code == 0xdd) return big(4);
        throw std::runtime_error("msgpack: expected an array");
    }

    bool nil() {
        if (at_ >= end_ || from_[at_] != 0xc0) return false;
        ++at_;
        return true;
    }

    Value value() {
        if (nil()) return std::monostate{};
        need(1);
        const auto code = from_[at_];
        if ((code >= 0x90 && code <= 0x9f) || code == 0xdc || code == 0xdd) {
            std::vector<std::string> texts;
            for (auto left = array(); left; --left) texts.push_back(std::get<std::string>(value()));
            return texts;
        }
        ++at_;
        if (code <= 0x7f) return std::int64_t{code};
        if (code >= 0xe0) return std::int64_t{static_cast<std::int8_t>(code)};
        if (code >= 0xa0 && code <= 0xbf) return text(code & 0x1f);
        switch (code) {
        case 0xc2: return false;
        case 0xc3: return true;
        case 0xcb: {
            const auto bits = big(8);
            double number;
            std::memcpy(&number, &bits, sizeof number);
            return number;
        }
        case 0xcc: return static_cast<std::int64_t>(big(1));
        case 0xcd: return static_cast<std::int64_t>(big(2));
        case 0xce: return static_cast<std::int64_t>(big(4));
        case 0xcf: return static_cast<std::int64_t>(big(8));
        case 0xd0: return std::int64_t{static_cast<std::int8_t>(big(1))};
        case 0xd1: return std::int64_t{static_cast<std::int16_t>(big(2))};
        case 0xd2: return std::int64_t{static_cast<std::int32_t>(big(4))};
        case 0xd3: return static_cast<std::int64_t>(big(8));
        case 0xd9: return text(big(1));
        case 0xda: return text(big(2));
        case 0xdb: return text(big(4));
        default: throw std::runtime_error("msgpack: a type that envelopes do not have");
        }
    }

    std::int64_t integer() { return std::get<std::int64_t>(value()); }
    std::string text() { return std::get<std::string>(value()); }

  private:
    void need(std::size_t size) const {
        if (size > end_ - at_) throw std::runtime_error("an envelope ends early");
    }

    std::uint64_t big(int size) {
        need(static_cast<std::size_t>(size));
        std::uint64_t value = 0;
        while (size--) value = value << 8 | from_[at_++];
        return value;
    }

    std::string text(std::size_t size) {
        need(size);
        std::string found(reinterpret_cast<const char *>(from_.data()) + at_, size);
        at_ += size;
        return found;
    }

    const Bytes &from_;
    std::size_t at_, end_;
};

constexpr std::size_t PRELUDE = 12, ALIGNMENT = 64;
constexpr std::uint8_t MAGIC[4] = {0x9c, 'D', 'F', 'E'};

inline Message decode(const Bytes &frame) {
    if (frame.size() < PRELUDE || std::memcmp(frame.data(), MAGIC, 4) != 0 || frame[4] != 1 || frame[5] != 1)
        throw std::runtime_error("a frame is no envelope of a message");
    std::uint16_t head = 0;
    std::uint32_t body = 0;
    std::memcpy(&head, frame.data() + 6, sizeof head);
    std::memcpy(&body, frame.data() + 8, sizeof body);
    Message message;
    Reader heads(frame, PRELUDE, PRELUDE + head);
    heads.array();
    message.port = heads.text();
    heads.integer();
    heads.integer();
    message.stamp = heads.integer();
    std::size_t at = PRELUDE + head + body;
    Reader bodies(frame, PRELUDE + head, at);
    bodies.array();
    message.schema = bodies.text();
    for (auto left = bodies.array(); left; --left) message.fields.push_back(bodies.value());
    for (auto left = bodies.array(); left; --left) {
        if (bodies.nil()) {
            message.arrays.emplace_back();
            continue;
        }
        bodies.array();
        Array array{bodies.text(), {}, {}};
        std::size_t size = std::stoul(array.dtype.substr(2));
        for (auto dimensions = bodies.array(); dimensions; --dimensions) {
            array.shape.push_back(static_cast<std::size_t>(bodies.integer()));
            size *= array.shape.back();
        }
        if (size) at += (ALIGNMENT - at % ALIGNMENT) % ALIGNMENT;
        if (at > frame.size() || size > frame.size() - at) throw std::runtime_error("an envelope ends early");
        array.bytes.assign(frame.begin() + static_cast<std::ptrdiff_t>(at),
                           frame.begin() + static_cast<std::ptrdiff_t>(at + size));
        at += size;
        message.arrays.push_back(std::move(array));
    }
    return message;
}

inline Bytes encode(const Message &message) {
    Bytes head, body, frame;
    pack_array(head, 6);
    pack(head, message.port);
    for (std::int64_t each : {std::int64_t{0}, std::int64_t{0}, message.stamp, std::int64_t{0}}) pack(head, each);
    pack(head, std::string());
    pack_array(body, 3);
    pack(body, message.schema);
    pack_array(body, message.fields.size());
    for (const auto &field : message.fields) pack(body, field);
    pack_array(body, message.arrays.size());
    for (const auto &array : message.arrays) {
        if (!array) {
            body.push_back(0xc0);
            continue;
        }
        pack_array(body, 2);
        pack(body, array->dtype);
        pack_array(body, array->shape.size());
        for (auto extent : array->shape) pack(body, static_cast<std::int64_t>(extent));
    }
    put(frame, MAGIC, sizeof MAGIC);
    put(frame, std::uint8_t{1});
    put(frame, std::uint8_t{1});
    put(frame, static_cast<std::uint16_t>(head.size()));
    put(frame, static_cast<std::uint32_t>(body.size()));
    put(frame, head.data(), head.size());
    put(frame, body.data(), body.size());
    for (const auto &array : message.arrays) {
        if (!array || array->bytes.empty()) continue;
        frame.resize(frame.size() + (ALIGNMENT - frame.size() % ALIGNMENT) % ALIGNMENT);
        put(frame, array->bytes.data(), array->bytes.size());
    }
    return frame;
}

template <typename T> T read() {
    T value;
    std::cin.read(reinterpret_cast<char *>(&value), sizeof value);
    return value;
}

inline void reply(std::uint8_t outcome, const std::vector<Bytes> &frames) {
    Bytes head;
    put(head, outcome);
    put(head, static_cast<std::uint32_t>(frames.size()));
    for (const auto &frame : frames) {
        put(head, static_cast<std::uint32_t>(frame.size()));
        put(head, frame.data(), frame.size());
    }
    std::cout.write(reinterpret_cast<const char *>(head.data()), static_cast<std::streamsize>(head.size()));
    std::cout.flush();
}

inline std::pair<std::string, std::string> setting(const Bytes &frame) {
    const std::string text(frame.begin(), frame.end());
    const auto equals = text.find('=');
    return {text.substr(0, equals), text.substr(equals + 1)};
}

inline std::vector<Bytes> encoded(const std::vector<Message> &messages) {
    std::vector<Bytes> frames;
    for (const auto &message : messages) frames.push_back(encode(message));
    return frames;
}

enum Kind : std::uint8_t { SETUP, PROCESS, FINISH, RESET, PARAMETER, SNAPSHOT, RESTORE };
enum Outcome : std::uint8_t { DONE, FAILED, NONE };

inline void answer(Operator &op, std::uint8_t kind, std::int64_t stamp, const std::vector<Bytes> &frames) {
    std::vector<Message> made;
    if (kind == SETUP) {
        Parameters parameters;
        for (const auto &frame : frames) parameters.insert(setting(frame));
        made = op.setup(parameters);
    } else if (kind == PROCESS) {
        std::vector<Message> inputs;
        for (const auto &frame : frames) inputs.push_back(decode(frame));
        made = op.process(stamp, inputs);
    } else if (kind == FINISH) {
        made = op.finish();
    } else if (kind == RESET) {
        op.reset(std::string(frames.at(0).begin(), frames.at(0).end()));
    } else if (kind == PARAMETER) {
        const auto [name, value] = setting(frames.at(0));
        op.parameter(name, value);
    } else if (kind == SNAPSHOT) {
        const auto state = op.snapshot();
        return state ? reply(DONE, {*state}) : reply(NONE, {});
    } else if (kind == RESTORE) {
        return reply(op.restore(frames.at(0)) ? DONE : NONE, {});
    } else {
        throw std::runtime_error("a call of an unknown kind");
    }
    reply(DONE, encoded(made));
}

} // namespace detail

// Answers calls until the graph ends; returns the exit code for main().
inline int run(Operator &op) {
    std::ios::sync_with_stdio(false);
    for (;;) {
        const auto kind = detail::read<std::uint8_t>();
        const auto stamp = detail::read<std::int64_t>();
        const auto count = detail::read<std::uint32_t>();
        if (!std::cin) return 0;
        std::vector<Bytes> frames;
        for (std::uint32_t number = 0; number < count; ++number) {
            Bytes frame(detail::read<std::uint32_t>());
            std::cin.read(reinterpret_cast<char *>(frame.data()), static_cast<std::streamsize>(frame.size()));
            frames.push_back(std::move(frame));
        }
        if (!std::cin) return 1;
        try {
            detail::answer(op, kind, stamp, frames);
        } catch (const std::exception &error) {
            const std::string text = error.what();
            detail::reply(detail::FAILED, {Bytes(text.begin(), text.end())});
            return 1;
        }
    }
}

} // namespace dataflow
