// A live stereo stream in C++17: submit frames from a camera's callback, take the newest depth in a
// renderer. Copy this file into your project; it needs gRPC, protobuf and zstd.
#pragma once

#include <grpcpp/grpcpp.h>
#include <zstd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "vergence_proto/v1/depth.grpc.pb.h"

namespace vergence {

namespace pb = vergence::v1;

// A rectified pair. Pixels, with centres at integers; the right camera is baseline_m to the right.
struct Rig {
  int width, height;
  double fx, fy, cx, cy, baseline_m;
};

// The left camera in the world, OpenCV axes: metres, and a unit quaternion x y z w.
struct Pose {
  double position_m[3] = {0, 0, 0};
  double orientation_xyzw[4] = {0, 0, 0, 1};
};

struct Depth {
  uint64_t frame_id = 0;
  int64_t capture_ns = 0;
  int width = 0, height = 0;
  std::vector<float> depth_m;  // rows top to bottom; NaN: no value
  bool warm = false;           // the step used what the stream remembers
};

// Nanoseconds of the clock that capture times are stated in.
inline int64_t now_ns() {
  return std::chrono::steady_clock::now().time_since_epoch() / std::chrono::nanoseconds(1);
}

// Undo COMPRESSION_DELTA_ZSTD of a UINT16 plane: bytes apart, folded signs, differences of rows.
inline std::vector<uint16_t> stored_values(const pb::Plane& plane) {
  const size_t width = plane.width(), count = width * plane.height();
  const std::string& data = plane.data();
  std::vector<uint16_t> values(count);
  if (plane.encoding() != pb::PLANE_ENCODING_UINT16) throw std::runtime_error("expected UINT16");
  if (plane.compression() != pb::COMPRESSION_DELTA_ZSTD) {
    if (data.size() != 2 * count) throw std::runtime_error("a plane of another size");
    for (size_t i = 0; i < count; ++i)
      values[i] = uint8_t(data[2 * i]) | uint16_t(uint8_t(data[2 * i + 1]) << 8);
    return values;
  }
  std::vector<uint8_t> bytes(2 * count);
  const size_t size = ZSTD_decompress(bytes.data(), bytes.size(), data.data(), data.size());
  if (ZSTD_isError(size) || size != bytes.size()) throw std::runtime_error("a damaged plane");
  for (size_t i = 0; i < count; ++i) {
    const uint16_t folded = bytes[i] | uint16_t(bytes[count + i] << 8);
    const uint16_t difference = (folded >> 1) ^ uint16_t(-(folded & 1));
    values[i] = difference + (i < width ? 0 : values[i - width]);
  }
  return values;
}

class Session {
 public:
  Session(const std::string& address, const Rig& rig) : rig_(rig) {
    grpc::ChannelArguments arguments;
    arguments.SetMaxReceiveMessageSize(64 << 20);
    stub_ = pb::DepthService::NewStub(
        grpc::CreateCustomChannel(address, grpc::InsecureChannelCredentials(), arguments));
    thread_ = std::thread([this] { run(); });
  }

  ~Session() {
    end();
    if (thread_.joinable()) thread_.join();
  }

  Session(const Session&) = delete;
  Session& operator=(const Session&) = delete;

  // Hand over a grey pair, rows without padding. Never waits: a frame that was not sent yet is
  // replaced. Any thread. A pose that is not known is a null pointer; the frame then starts cold.
  void submit(const uint8_t* left, const uint8_t* right, const Pose* world_from_left,
              int64_t capture_ns) {
    auto frame = std::make_unique<pb::Frame>();
    frame->set_capture_ns(capture_ns);
    fill(frame->mutable_left(), left);
    fill(frame->mutable_right(), right);
    if (world_from_left != nullptr) {
      pb::PoseSample& sample = *frame->mutable_pose();
      pb::Pose& pose = *sample.mutable_world_from_left();
      pose.mutable_position_m()->set_x(world_from_left->position_m[0]);
      pose.mutable_position_m()->set_y(world_from_left->position_m[1]);
      pose.mutable_position_m()->set_z(world_from_left->position_m[2]);
      pose.mutable_orientation()->set_x(world_from_left->orientation_xyzw[0]);
      pose.mutable_orientation()->set_y(world_from_left->orientation_xyzw[1]);
      pose.mutable_orientation()->set_z(world_from_left->orientation_xyzw[2]);
      pose.mutable_orientation()->set_w(world_from_left->orientation_xyzw[3]);
      sample.set_orientation_valid(true);
      sample.set_position_valid(true);
      sample.set_tracked(true);
    }
    const std::lock_guard lock(mutex_);
    waiting_ = std::move(frame);
    changed_.notify_all();
  }

  // The newest depth, or nothing yet. Any thread; never waits for the network.
  std::shared_ptr<const Depth> latest() const {
    const std::lock_guard lock(mutex_);
    return latest_;
  }

  // Why the stream ended; empty while it lives. What a retry can cure is retried without a word.
  std::string error() const {
    const std::lock_guard lock(mutex_);
    return error_;
  }

  // No frame follows.
  void end() {
    const std::lock_guard lock(mutex_);
    ending_ = true;
    changed_.notify_all();
  }

 private:
  using Call = grpc::ClientReaderWriter<pb::StreamDepthRequest, pb::StreamDepthResponse>;

  static constexpr auto kRetry = std::chrono::milliseconds(300);

  void fill(pb::Image* image, const uint8_t* pixels) const {
    image->set_encoding(pb::IMAGE_ENCODING_MONO8);
    image->set_width(rig_.width);
    image->set_height(rig_.height);
    image->set_data(pixels, size_t(rig_.width) * rig_.height);
  }

  // Attach, and attach again with the resume token, for as long as the server knows the stream.
  void run() {
    for (;;) {
      const grpc::Status status = attach();
      std::unique_lock lock(mutex_);
      if (ending_ || status.ok()) return;
      switch (status.error_code()) {
        case grpc::StatusCode::UNAVAILABLE:  // no connection, not ready yet, or shutting down
        case grpc::StatusCode::RESOURCE_EXHAUSTED:
          break;
        case grpc::StatusCode::NOT_FOUND:  // the server was restarted, or the state has expired
          if (token_.empty()) return fail(status);
          token_.clear();
          id_.clear();
          break;
        default:
          return fail(status);
      }
      changed_.wait_for(lock, kRetry, [this] { return ending_; });
    }
  }

  void fail(const grpc::Status& status) { error_ = status.error_message(); }

  grpc::Status attach() {
    grpc::ClientContext context;
    const std::shared_ptr<Call> call(stub_->StreamDepth(&context));
    pb::StreamDepthRequest request;
    pb::OpenStream& open = *request.mutable_open();
    open.set_stream_id(id_);
    open.set_resume_token(token_);
    open.set_axes(pb::AXES_OPENCV);
    open.set_delivery(pb::DELIVERY_NEWEST);
    open.mutable_output()->set_compression(pb::COMPRESSION_DELTA_ZSTD);
    for (pb::Camera* camera : {open.mutable_rig()->mutable_left(), open.mutable_rig()->mutable_right()}) {
      camera->set_width(rig_.width);
      camera->set_height(rig_.height);
      camera->set_fx(rig_.fx);
      camera->set_fy(rig_.fy);
      camera->set_cx(rig_.cx);
      camera->set_cy(rig_.cy);
      camera->set_distortion(pb::DISTORTION_NONE);
    }
    open.mutable_rig()->mutable_left_from_right()->mutable_position_m()->set_x(rig_.baseline_m);
    open.mutable_rig()->mutable_left_from_right()->mutable_orientation()->set_w(1);
    call->Write(request);

    std::thread writer;
    pb::StreamDepthResponse response;
    while (call->Read(&response)) {
      if (response.has_opened()) {
        const std::lock_guard lock(mutex_);
        id_ = response.opened().stream_id();
        token_ = response.opened().resume_token();
        last_id_ = response.opened().last_frame_id();
        credit_ = std::max<uint32_t>(response.opened().credit(), 1);
        unanswered_ = 0;
        attached_ = true;
        writer = std::thread([this, call] { write(*call); });
      } else {
        take(response);
      }
    }
    {
      const std::lock_guard lock(mutex_);
      attached_ = false;
      changed_.notify_all();
    }
    if (writer.joinable()) writer.join();
    return call->Finish();
  }

  // Send the newest frame whenever fewer than the credit are unanswered.
  void write(Call& call) {
    for (;;) {
      pb::StreamDepthRequest request;
      {
        std::unique_lock lock(mutex_);
        changed_.wait(lock, [this] {
          return !attached_ || ending_ || (waiting_ && unanswered_ < credit_);
        });
        if (!attached_) return;
        if (ending_) {
          request.mutable_end();
        } else {
          request.set_allocated_frame(waiting_.release());
          request.mutable_frame()->set_frame_id(++last_id_);
          ++unanswered_;
        }
      }
      if (!call.Write(request) || request.has_end()) return;
    }
  }

  void take(const pb::StreamDepthResponse& response) {
    std::shared_ptr<Depth> depth;
    uint32_t answered = 0;
    if (response.has_disparity()) {
      depth = depth_of(response.disparity());
      answered = 1;
    } else if (response.has_frame_error()) {
      answered = 1;  // the stream lives on
    } else if (response.has_frames_dropped()) {
      answered = response.frames_dropped().frame_ids_size();
    }
    const std::lock_guard lock(mutex_);
    if (depth) latest_ = std::move(depth);
    unanswered_ -= std::min(unanswered_, answered);
    changed_.notify_all();
  }

  std::shared_ptr<Depth> depth_of(const pb::DisparityMap& map) const {
    auto depth = std::make_shared<Depth>();
    depth->frame_id = map.frame_id();
    depth->capture_ns = map.capture_ns();
    depth->width = map.disparity().width();
    depth->height = map.disparity().height();
    depth->warm = map.origin() == pb::ORIGIN_WARM || map.origin() == pb::ORIGIN_RESUMED;
    const double scale = rig_.fx * rig_.baseline_m * map.disparity().denominator();
    for (const uint16_t value : stored_values(map.disparity()))
      depth->depth_m.push_back(value == 0 ? NAN : float(scale / value));
    return depth;
  }

  const Rig rig_;
  std::unique_ptr<pb::DepthService::Stub> stub_;
  mutable std::mutex mutex_;
  std::condition_variable changed_;
  std::unique_ptr<pb::Frame> waiting_;
  std::shared_ptr<const Depth> latest_;
  std::string id_, token_, error_;
  uint64_t last_id_ = 0;
  uint32_t credit_ = 1, unanswered_ = 0;
  bool attached_ = false, ending_ = false;
  std::thread thread_;  // last: it uses all of the above
};

}  // namespace vergence
