// Evaluates a CasADi function at many instants: each operation for several instants at a time, in the processor's vector
// registers. Without compiling, this takes a fraction of the time of CasADi's own evaluation.
#include <algorithm>
#include <cmath>

#include "bind/checks.hpp"
#include "tree/widest_registers.hpp"

namespace ckc {

using namespace nb::literals;

namespace {

constexpr Eigen::Index width = 16;  // instants at a time

// By name, in Python and here.
#define OPERATIONS(X)                                                                                       \
  X(constant) X(input) X(output) X(copy) X(add) X(subtract) X(multiply) X(divide) X(negate) X(square)        \
  X(twice) X(invert) X(square_root) X(sine) X(cosine) X(tangent) X(arcus_tangent) X(absolute) X(less)        \
  X(less_or_equal) X(equal) X(unequal) X(inverse_truth) X(both) X(either) X(if_else_zero) X(smaller)         \
  X(larger) X(power)

#define AS_ENUMERATOR(name) name,
#define AS_TEXT(name) #name,
enum class Operation { OPERATIONS(AS_ENUMERATOR) };
constexpr const char* operation_names[] = {OPERATIONS(AS_TEXT)};

struct alignas(64) Numbers {
  double x[width];
};

// One operation. `constant`: of constants[a]; `input`: entry b of argument a; `output`: of number a to entry b of result
// `to`; else of numbers a and b.
struct Instruction {
  Operation operation;
  int to, a, b;
};

using Tape = nb::ndarray<const int, nb::c_contig, nb::device::cpu, nb::shape<-1, 4>>;
using Arguments = std::vector<nb::ndarray<const double, nb::c_contig, nb::device::cpu, nb::ndim<2>>>;
using Results = std::vector<nb::ndarray<double, nb::c_contig, nb::device::cpu, nb::ndim<2>>>;

template <class Function>
[[gnu::always_inline]] inline void each(Numbers& to, const Numbers& a, const Function& f) {
  for (int k = 0; k < width; ++k) to.x[k] = f(a.x[k]);
}

template <class Function>
[[gnu::always_inline]] inline void each(Numbers& to, const Numbers& a, const Numbers& b, const Function& f) {
  for (int k = 0; k < width; ++k) to.x[k] = f(a.x[k], b.x[k]);
}

// Apply an operation of one or two numbers.
[[gnu::always_inline]] inline void apply(Operation operation, Numbers& to, const Numbers& a, const Numbers& b) {
  switch (operation) {
    case Operation::copy: each(to, a, [](double x) { return x; }); break;
    case Operation::add: each(to, a, b, [](double x, double y) { return x + y; }); break;
    case Operation::subtract: each(to, a, b, [](double x, double y) { return x - y; }); break;
    case Operation::multiply: each(to, a, b, [](double x, double y) { return x * y; }); break;
    case Operation::divide: each(to, a, b, [](double x, double y) { return x / y; }); break;
    case Operation::negate: each(to, a, [](double x) { return -x; }); break;
    case Operation::square: each(to, a, [](double x) { return x * x; }); break;
    case Operation::twice: each(to, a, [](double x) { return x + x; }); break;
    case Operation::invert: each(to, a, [](double x) { return 1.0 / x; }); break;
    case Operation::square_root: each(to, a, [](double x) { return std::sqrt(x); }); break;
    case Operation::sine: each(to, a, [](double x) { return std::sin(x); }); break;
    case Operation::cosine: each(to, a, [](double x) { return std::cos(x); }); break;
    case Operation::tangent: each(to, a, [](double x) { return std::tan(x); }); break;
    case Operation::arcus_tangent: each(to, a, b, [](double x, double y) { return std::atan2(x, y); }); break;
    case Operation::absolute: each(to, a, [](double x) { return std::fabs(x); }); break;
    case Operation::less: each(to, a, b, [](double x, double y) { return x < y ? 1.0 : 0.0; }); break;
    case Operation::less_or_equal: each(to, a, b, [](double x, double y) { return x <= y ? 1.0 : 0.0; }); break;
    case Operation::equal: each(to, a, b, [](double x, double y) { return x == y ? 1.0 : 0.0; }); break;
    case Operation::unequal: each(to, a, b, [](double x, double y) { return x != y ? 1.0 : 0.0; }); break;
    case Operation::inverse_truth: each(to, a, [](double x) { return x == 0.0 ? 1.0 : 0.0; }); break;
    case Operation::both: each(to, a, b, [](double x, double y) { return x != 0.0 && y != 0.0 ? 1.0 : 0.0; }); break;
    case Operation::either: each(to, a, b, [](double x, double y) { return x != 0.0 || y != 0.0 ? 1.0 : 0.0; }); break;
    case Operation::if_else_zero: each(to, a, b, [](double x, double y) { return x != 0.0 ? y : 0.0; }); break;
    case Operation::smaller: each(to, a, b, [](double x, double y) { return std::fmin(x, y); }); break;
    case Operation::larger: each(to, a, b, [](double x, double y) { return std::fmax(x, y); }); break;
    case Operation::power: each(to, a, b, [](double x, double y) { return std::pow(x, y); }); break;
    default: break;  // handled above
  }
}

WITH_WIDEST_REGISTERS void run(const std::vector<Instruction>& instructions, const Eigen::Map<const Vector>& constants,
                               const Arguments& arguments, const Results& results, Eigen::Index first,
                               Eigen::Index count, Numbers* numbers) {
  for (const Instruction& i : instructions) {
    if (i.operation == Operation::output) {
      const auto& table = results[static_cast<size_t>(i.to)];
      const auto columns = static_cast<Eigen::Index>(table.shape(1));
      double* out = table.data() + first * columns + i.b;
      for (Eigen::Index k = 0; k < count; ++k) out[k * columns] = numbers[i.a].x[k];
      continue;
    }
    Numbers& to = numbers[i.to];
    if (i.operation == Operation::constant) {
      std::fill_n(to.x, width, constants(i.a));
      continue;
    }
    if (i.operation == Operation::input) {
      const auto& table = arguments[static_cast<size_t>(i.a)];
      const auto columns = static_cast<Eigen::Index>(table.shape(1));
      const double* in = table.data() + first * columns + i.b;
      for (Eigen::Index k = 0; k < width; ++k) to.x[k] = in[std::min(k, count - 1) * columns];
      continue;
    }
    const Numbers &a = numbers[i.a], &b = numbers[i.b];
    apply(i.operation, to, a, b);
  }
}

class ManyInstants {
 public:
  // Each row of the tape is an instruction, whose operation is one of `operations` by number. `parameters` are the last
  // argument, which is the same at all instants.
  ManyInstants(const std::vector<std::string>& operations, const Tape& tape, VectorArg constants, VectorArg parameters,
               int numbers, const Indices& argument_sizes, const Indices& result_sizes)
      : number_count_(numbers), argument_sizes_(argument_sizes), result_sizes_(result_sizes) {
    std::vector<Operation> by_number;
    for (const std::string& operation : operations) {
      const auto name = std::find(std::begin(operation_names), std::end(operation_names), operation);
      require(name != std::end(operation_names), "operations: " + operation + " is not supported");
      by_number.push_back(static_cast<Operation>(name - std::begin(operation_names)));
    }
    require(!argument_sizes.empty() && argument_sizes.back() == parameters.size(), "parameters: wrong number");
    std::vector<Instruction> instructions;
    for (size_t k = 0; k < tape.shape(0); ++k) {
      require(tape(k, 0) >= 0 && static_cast<size_t>(tape(k, 0)) < by_number.size(), "operations: wrong index");
      instructions.push_back({by_number[static_cast<size_t>(tape(k, 0))], tape(k, 1), tape(k, 2), tape(k, 3)});
      check(instructions.back(), constants.size());
    }
    fold_constants(instructions, constants, parameters);
    argument_sizes_.pop_back();
  }

  // Evaluate at as many instants as the tables have rows.
  void evaluate(const Arguments& arguments, const Results& results) const {
    require(arguments.size() == argument_sizes_.size() && results.size() == result_sizes_.size(), "tables: wrong number");
    const size_t rows = arguments.empty() ? 0 : arguments[0].shape(0);
    const auto require_sizes = [&](const auto& tables, const Indices& sizes) {
      for (size_t k = 0; k < tables.size(); ++k)
        require(tables[k].shape(0) == rows && tables[k].shape(1) == static_cast<size_t>(sizes[k]), "tables: wrong shape");
    };
    require_sizes(arguments, argument_sizes_), require_sizes(results, result_sizes_);
    nb::gil_scoped_release released;
    std::vector<Numbers> numbers(static_cast<size_t>(number_count_));
    const Eigen::Map<const Vector> constants(constants_.data(), static_cast<Eigen::Index>(constants_.size()));
    const auto count = static_cast<Eigen::Index>(rows);
    for (Eigen::Index first = 0; first < count; first += width)
      run(instructions_, constants, arguments, results, first, std::min(width, count - first), numbers.data());
  }

 private:
  void check(const Instruction& i, Eigen::Index constant_count) const {
    const auto require_below = [](int k, Eigen::Index size) { require(k >= 0 && k < size, "operations: wrong index"); };
    const auto sizes = [](const Indices& of, int k) { return static_cast<Eigen::Index>(of[static_cast<size_t>(k)]); };
    if (i.operation == Operation::output) {
      require_below(i.to, static_cast<Eigen::Index>(result_sizes_.size()));
      require_below(i.b, sizes(result_sizes_, i.to)), require_below(i.a, number_count_);
      return;
    }
    require_below(i.to, number_count_);
    if (i.operation == Operation::constant) return require_below(i.a, constant_count);
    if (i.operation == Operation::input) {
      require_below(i.a, static_cast<Eigen::Index>(argument_sizes_.size()));
      return require_below(i.b, sizes(argument_sizes_, i.a));
    }
    require_below(i.a, number_count_), require_below(i.b, number_count_);
  }

  // Operations on constants and parameters are done once, here.
  void fold_constants(const std::vector<Instruction>& instructions, VectorArg constants, VectorArg parameters) {
    struct State {
      bool is_constant = false, is_loaded = false;
    };
    const auto count = static_cast<size_t>(number_count_);
    std::vector<State> states(count);
    std::vector<Numbers> numbers(count);
    const int parameter_argument = static_cast<int>(argument_sizes_.size()) - 1;
    const auto set = [&](int k, double value) {
      std::fill_n(numbers[static_cast<size_t>(k)].x, width, value);
      states[static_cast<size_t>(k)] = {true, false};
    };
    const auto load = [&](int k) {
      State& state = states[static_cast<size_t>(k)];
      if (!state.is_constant || state.is_loaded) return;
      instructions_.push_back({Operation::constant, k, static_cast<int>(constants_.size()), 0});
      constants_.push_back(numbers[static_cast<size_t>(k)].x[0]);
      state.is_loaded = true;
    };
    for (const Instruction& i : instructions) {
      if (i.operation == Operation::output) {
        load(i.a);
        instructions_.push_back(i);
      } else if (i.operation == Operation::constant) {
        set(i.to, constants(i.a));
      } else if (i.operation == Operation::input && i.a == parameter_argument) {
        set(i.to, parameters(i.b));
      } else if (i.operation == Operation::input) {
        states[static_cast<size_t>(i.to)] = {};
        instructions_.push_back(i);
      } else if (states[static_cast<size_t>(i.a)].is_constant && states[static_cast<size_t>(i.b)].is_constant) {
        Numbers result;
        apply(i.operation, result, numbers[static_cast<size_t>(i.a)], numbers[static_cast<size_t>(i.b)]);
        set(i.to, result.x[0]);
      } else {
        load(i.a), load(i.b);
        states[static_cast<size_t>(i.to)] = {};
        instructions_.push_back(i);
      }
    }
  }

  std::vector<Instruction> instructions_;
  std::vector<double> constants_;
  int number_count_;
  Indices argument_sizes_, result_sizes_;
};

}  // namespace

void bind_many(nb::module_& m) {
  nb::class_<ManyInstants>(m, "ManyInstants", "Evaluates a CasADi function at many instants.")
      .def(nb::init<const std::vector<std::string>&, const Tape&, VectorArg, VectorArg, int, const Indices&,
                    const Indices&>(),
           "operations"_a, "tape"_a, nb::kw_only(), "constants"_a, "parameters"_a, "numbers"_a, "argument_sizes"_a,
           "result_sizes"_a,
           nb::sig("def __init__(self, operations: Sequence[str], tape: numpy.typing.NDArray[numpy.int32], *, "
                   "constants: numpy.typing.NDArray[numpy.float64], parameters: numpy.typing.NDArray[numpy.float64], "
                   "numbers: int, argument_sizes: Sequence[int], result_sizes: Sequence[int]) -> None"))
      .def("evaluate", &ManyInstants::evaluate, "arguments"_a, "results"_a,
           nb::sig("def evaluate(self, arguments: list[numpy.typing.NDArray[numpy.float64]], "
                   "results: list[numpy.typing.NDArray[numpy.float64]]) -> None"),
           "Write results (instants, entries) at arguments (instants, entries).");
}

}  // namespace ckc
