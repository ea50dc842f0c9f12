// A client of `spacesim serve` in C++, by libzmq's C interface: asks for a picture with its depth, writes a PPM file.
//
//     g++ -O2 client.cpp -lzmq -o client && ./client tcp://127.0.0.1:5556 view.ppm
//
// spacesim/serve/protocol.py describes the protocol.
#include <cstdint>
#include <cstdio>
#include <string>
#include <vector>
#include <zmq.h>

struct Pose {
    double position[3];       // metres, world: from the target's origin
    double rotation_wxyz[4];  // from camera axes (x right, y down, z forward) to the world's
};

// Frames of the answer: its header, then an array each. Nothing where none comes within a minute.
std::vector<std::string> ask(void* socket, const Pose& pose, const double sun[3], int size, double fov_deg, int frame) {
    char text[512];
    const double *p = pose.position, *q = pose.rotation_wxyz;
    int length = std::snprintf(
        text, sizeof text,
        R"({"version": 1, "id": %d, "seed": %d, "outputs": ["rgb", "depth"], "sun": [%.17g, %.17g, %.17g], "camera": )"
        R"({"width": %d, "height": %d, "fov_deg": %.17g, "position": [%.17g, %.17g, %.17g], )"
        R"("rotation_wxyz": [%.17g, %.17g, %.17g, %.17g]}})",
        frame, frame, sun[0], sun[1], sun[2], size, size, fov_deg, p[0], p[1], p[2], q[0], q[1], q[2], q[3]);
    if (zmq_send(socket, text, length, 0) < 0) return {};
    std::vector<std::string> frames;
    int more = 1;
    while (more) {
        zmq_msg_t part;
        zmq_msg_init(&part);
        if (zmq_msg_recv(&part, socket, 0) < 0) return {};
        frames.emplace_back(static_cast<char*>(zmq_msg_data(&part)), zmq_msg_size(&part));
        more = zmq_msg_more(&part);
        zmq_msg_close(&part);
    }
    return frames;
}

int main(int count, char** words) {
    const int size = 64, patience = 60000, linger = 0;
    void* context = zmq_ctx_new();
    void* socket = zmq_socket(context, ZMQ_REQ);
    zmq_setsockopt(socket, ZMQ_RCVTIMEO, &patience, sizeof patience);
    zmq_setsockopt(socket, ZMQ_LINGER, &linger, sizeof linger);
    const bool connected = !zmq_connect(socket, count > 1 ? words[1] : "tcp://127.0.0.1:5556");

    const Pose pose = {{10, 0, 0}, {0.5, -0.5, -0.5, 0.5}};  // looks along -x, z is up
    const double sun[3] = {1.0, 0.5, 0.8};
    std::vector<std::string> frames;
    if (connected) frames = ask(socket, pose, sun, size, 30.0, 0);
    zmq_close(socket);
    zmq_ctx_term(context);
    if (frames.size() != 3) {  // an error is a header alone
        std::fprintf(stderr, "%s\n", frames.empty() ? "no answer" : frames[0].c_str());
        return 1;
    }
    const float* depth = reinterpret_cast<const float*>(frames[2].data());
    std::printf("%s\ndepth in the middle: %.3f m\n", frames[0].c_str(), depth[size / 2 * size + size / 2]);
    std::FILE* file = std::fopen(count > 2 ? words[2] : "view.ppm", "wb");
    if (!file) return 1;
    std::fprintf(file, "P6 %d %d 255\n", size, size);
    std::fwrite(frames[1].data(), 1, frames[1].size(), file);
    return std::fclose(file) ? 1 : 0;
}
