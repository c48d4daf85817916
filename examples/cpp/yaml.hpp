// Reads the YAML that `--export` writes: mappings, lists and scalars, each on lines of their own. Nothing else of YAML: a {flow} or
// [flow] collection stays text, and asking it for a number or a list is an error that names its line.
#pragma once

#include <algorithm>
#include <fstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace legged_mw {

struct Yaml {
  int line = 0;
  std::string text;                               // of a scalar
  std::vector<Yaml> list;                         // of a list
  std::vector<std::pair<std::string, Yaml>> map;  // of a mapping, in its order

  [[noreturn]] void fail(const std::string& what) const {
    throw std::runtime_error("policy.yaml, line " + std::to_string(line) + ": " + what);
  }
  const Yaml* find(const std::string& key) const {
    for (const auto& [name, value] : map)
      if (name == key) return &value;
    return nullptr;
  }
  const Yaml& operator[](const std::string& key) const {
    if (const Yaml* value = find(key)) return *value;
    fail("'" + key + "' is missing");
  }
  double number() const {
    size_t read = 0;
    double value = 0;
    try {
      value = std::stod(text, &read);
    } catch (const std::logic_error&) {
    }
    if (!read || read != text.size()) fail("'" + text + "' is no number");
    return value;
  }
  const std::vector<Yaml>& items() const {
    if (list.empty() && text != "[]") fail("'" + text + "' is no list; write one as --export does: '- ' and one value a line");
    return list;
  }
  std::vector<double> numbers() const {
    std::vector<double> values;
    for (const Yaml& item : items()) values.push_back(item.number());
    return values;
  }
};

class YamlReader {
 public:
  explicit YamlReader(const std::string& path) {
    std::ifstream file(path);
    if (!file) throw std::runtime_error("cannot read " + path);
    int number = 0;
    for (std::string line; std::getline(file, line);) {
      const size_t indent = line.find_first_not_of(' '), last = line.find_last_not_of(" \r");
      ++number;
      if (indent < line.size() && line[indent] != '#') lines_.push_back({number, indent, line.substr(indent, last + 1 - indent)});
    }
  }
  Yaml read() {
    const Yaml node = lines_.empty() ? Yaml{} : block();
    if (next_ < lines_.size()) Yaml{lines_[next_].number, "", {}, {}}.fail("'" + lines_[next_].text + "' is not understood here");
    return node;
  }

 private:
  struct Line {
    int number;
    size_t indent;
    std::string text;
    bool entry() const { return text.rfind("- ", 0) == 0; }
    size_t colon() const {  // after the key of a mapping
      if (text[0] == '\'' || text[0] == '"') return std::string::npos;
      const size_t colon = text.find(": ");
      return colon == std::string::npos && text.back() == ':' ? text.size() - 1 : colon;
    }
  };
  std::vector<Line> lines_;
  size_t next_ = 0;

  bool more(size_t indent) const { return next_ < lines_.size() && lines_[next_].indent == indent; }

  Yaml block() {  // the mapping, list or scalar that begins at the next line
    Line& first = lines_[next_];
    const size_t indent = first.indent;
    Yaml node{first.number, "", {}, {}};
    if (first.entry()) {
      while (more(indent) && lines_[next_].entry()) {
        Line& line = lines_[next_];
        line.text.erase(0, 2);
        line.indent += 2;
        node.list.push_back(line.entry() || line.colon() != std::string::npos ? block() : scalar(indent));
      }
      return node;
    }
    if (first.colon() == std::string::npos) return scalar(indent);
    while (more(indent) && !lines_[next_].entry() && lines_[next_].colon() != std::string::npos) {
      Line& line = lines_[next_];
      const size_t colon = line.colon();
      const std::string key = line.text.substr(0, colon);
      line.text.erase(0, std::min(colon + 2, line.text.size()));
      if (!line.text.empty()) {
        node.map.emplace_back(key, scalar(indent));
      } else {
        const bool below = ++next_ < lines_.size() && (lines_[next_].indent > indent || (more(indent) && lines_[next_].entry()));
        node.map.emplace_back(key, below ? block() : Yaml{line.number, "", {}, {}});
      }
    }
    return node;
  }
  Yaml scalar(size_t indent) {  // of this line and those that it goes on in, which are deeper
    Yaml node{lines_[next_].number, lines_[next_].text, {}, {}};
    for (++next_; next_ < lines_.size() && lines_[next_].indent > indent; ++next_) node.text += " " + lines_[next_].text;
    const char quote = node.text[0];
    if (node.text.size() > 1 && (quote == '\'' || quote == '"')) node.text = node.text.substr(1, node.text.size() - 2);
    return node;
  }
};

}  // namespace legged_mw
