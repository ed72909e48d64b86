// Torques of a robot in a program without Python: q, qd and qdd of every sample from standard input, a line of torques out.
//
//     torques LAYER.pt2 N < motion.txt
//
// LAYER.pt2 is a DQRNEA of N joints in float64, as docs/export.md makes it. It needs libtorch, that of torch's wheel will do.

#include <iomanip>
#include <iostream>
#include <iterator>
#include <limits>
#include <vector>

#include <ATen/ops/from_blob.h>
#include <torch/csrc/inductor/aoti_package/model_package_loader.h>

int main(int count, char** words) {
    if (count != 3) {
        std::cerr << "usage: torques LAYER.pt2 JOINTS < motion.txt\n";
        return 2;
    }
    const int64_t n = std::stoll(words[2]);
    std::vector<double> read{std::istream_iterator<double>(std::cin), {}};
    if (n < 1 || read.empty() || read.size() % (3 * n) != 0) {
        std::cerr << "expected " << 3 * n << " numbers for every sample, q, qd and qdd; found " << read.size() << "\n";
        return 1;
    }
    const int64_t samples = read.size() / (3 * n);
    torch::inductor::AOTIModelPackageLoader layer(words[1]);
    const at::Tensor motion = at::from_blob(read.data(), {samples, 3, n}, at::kDouble);
    const at::Tensor tau = layer.run({motion.select(1, 0).contiguous(), motion.select(1, 1).contiguous(),
                                      motion.select(1, 2).contiguous()})[0].contiguous();
    std::cout << std::setprecision(std::numeric_limits<double>::max_digits10);
    for (int64_t k = 0; k < samples; ++k)
        for (int64_t j = 0; j < n; ++j)
            std::cout << tau.data_ptr<double>()[k * n + j] << (j + 1 < n ? ' ' : '\n');
}
