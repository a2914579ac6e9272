// Stream one grey pair to a server as a camera would, and print the depth that comes back.
//   depth_client HOST:PORT LEFT.pgm RIGHT.pgm FX CX CY BASELINE_M FRAMES
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>

#include "vergence.hpp"

namespace {

struct Image {
  int width = 0, height = 0;
  std::vector<uint8_t> pixels;
};

Image read_pgm(const char* path) {
  std::ifstream file(path, std::ios::binary);
  std::string magic;
  int largest = 0;
  Image image;
  file >> magic >> image.width >> image.height >> largest;
  file.get();
  if (!file || magic != "P5" || largest != 255)
    throw std::runtime_error(std::string(path) + ": expected a PGM of 8 bits");
  image.pixels.resize(size_t(image.width) * image.height);
  file.read(reinterpret_cast<char*>(image.pixels.data()), std::streamsize(image.pixels.size()));
  if (!file) throw std::runtime_error(std::string(path) + ": the file is cut short");
  return image;
}

float median(std::vector<float> values) {
  values.erase(std::remove_if(values.begin(), values.end(), [](float v) { return std::isnan(v); }),
               values.end());
  if (values.empty()) return NAN;
  std::nth_element(values.begin(), values.begin() + values.size() / 2, values.end());
  return values[values.size() / 2];
}

}  // namespace

int main(int count, char** arguments) try {
  if (count != 9) {
    std::cerr << "usage: depth_client HOST:PORT LEFT.pgm RIGHT.pgm FX CX CY BASELINE_M FRAMES\n";
    return 2;
  }
  const Image left = read_pgm(arguments[2]), right = read_pgm(arguments[3]);
  const double fx = std::atof(arguments[4]);
  const vergence::Rig rig{left.width, left.height, fx, fx, std::atof(arguments[5]),
                          std::atof(arguments[6]), std::atof(arguments[7])};
  const uint64_t frames = std::strtoull(arguments[8], nullptr, 10);
  const vergence::Pose at_rest;

  vergence::Session session(arguments[1], rig);
  uint64_t shown = 0;
  while (shown < frames) {
    session.submit(left.pixels.data(), right.pixels.data(), &at_rest, vergence::now_ns());
    std::this_thread::sleep_for(std::chrono::milliseconds(33));
    const auto depth = session.latest();
    if (depth && depth->frame_id != shown) {
      shown = depth->frame_id;
      std::printf("frame %llu: %dx%d, median %.3f m, %s, %.0f ms old\n",
                  static_cast<unsigned long long>(shown), depth->width, depth->height,
                  median(depth->depth_m), depth->warm ? "warm" : "cold",
                  double(vergence::now_ns() - depth->capture_ns) * 1e-6);
    }
    if (!session.error().empty()) throw std::runtime_error(session.error());
  }
  return 0;
} catch (const std::exception& error) {
  std::cerr << "depth_client: " << error.what() << '\n';
  return 1;
}
