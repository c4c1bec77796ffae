// The plain C interface of the kernels: raw pointers, sizes and a stream. Included by cuda.cu, which
// runs them on a GPU, and by host.cpp, which runs the same threads in a loop.
//
// Every launcher returns 0, or the error of the runtime; `size` is that of a number, 4 or 8.
#pragma once

#include "step_kernels.h"
#include "view_kernels.h"

namespace dw {

template <class S>
int launch_system(const Job& job, void* stream) {
    Queue queue(stream);
    map(queue, job.edges, CompareEdges{job});
    map(queue, job.edges, RelativeMotions<S>{
        job, static_cast<const S*>(job.T_cw), reinterpret_cast<Motion<double>*>(job.motions),
        static_cast<Motion<S>*>(job.rounded)});
    const int64_t groups = job.edges * job.chunks;
    if (job.channels == 3) reduce<EDGE_SUMS>(queue, groups, LineariseEdges<S, true>{job}, job.edge_part);
    else reduce<EDGE_SUMS>(queue, groups, LineariseEdges<S, false>{job}, job.edge_part);
    map(queue, job.edges * EDGE_SUMS, EdgeTotals{job});
    map(queue, job.frames, FreePoses{job});
    if (!job.motion_only) {
        map(queue, job.sources * job.cells(), DepthSystem<S>{job});
        reduce<PAIR_SUMS>(queue, job.pairs * job.chunks, PairProducts<S>{job}, job.pair_part);
    }
    map(queue, job.pairs * PAIR_SUMS, PairTotals{job});
    map(queue, job.edges * 36, TurnedSums{job});
    map(queue, job.sources * 36, OwnSums{job});
    map(queue, job.blocks * 36, AssembleBlocks{job});
    map(queue, job.frames * 6, DampDiagonal{job});
    return queue.code();
}

template <class S>
int launch_move(const Job& job, void* stream) {
    Queue queue(stream);
    map(queue, job.frames, MovePoses<S>{job});
    map(queue, job.frames * job.cells(), MoveDepths<S>{job});
    return queue.code();
}

// Everything between the solution of the system and what is read back.
template <class S>
int launch_finish(const Job& job, void* stream) {
    Queue queue(stream);
    if (job.factor) map(queue, 6 * job.frames, CheckPivots{job});
    if (!job.motion_only) {
        map(queue, job.edges, SeenSteps<S>{job});
        map(queue, job.sources * job.cells(), Substitute<S>{job});
    }
    map(queue, job.frames, MovePoses<S>{job});
    map(queue, job.frames * job.cells(), MoveDepths<S>{job});
    reduce<2>(queue, 1, EdgeEnergy{job}, job.told + FLAGS);
    const int64_t chunks = job.prior && !job.motion_only ? job.frames * job.chunks : 0;
    double* const part = job.energy_part + job.edges * job.chunks;
    reduce<1>(queue, chunks, PriorEnergy<S>{job, static_cast<const S*>(job.disps)}, part);
    reduce<1>(queue, 1, RowSum{part, chunks}, job.told + FLAGS + 2);
    map(queue, job.frames, TellPoses{job});
    map(queue, FLAGS, TellFlags{job});
    return queue.code();
}

template <class S>
int launch_energy(const Job& job, const void* T_cw, const void* disps, void* moved, void* stream) {
    Queue queue(stream);
    const S* d = static_cast<const S*>(disps);
    Motion<S>* to = static_cast<Motion<S>*>(moved);
    map(queue, job.edges, RelativeMotions<S>{job, static_cast<const S*>(T_cw), nullptr, to});
    const int64_t groups = job.edges * job.chunks;
    if (job.channels == 3) reduce<1>(queue, groups, MovedEnergy<S, true>{job, d, to}, job.energy_part);
    else reduce<1>(queue, groups, MovedEnergy<S, false>{job, d, to}, job.energy_part);
    const int64_t chunks = job.prior && !job.motion_only ? job.frames * job.chunks : 0;
    reduce<1>(queue, chunks, PriorEnergy<S>{job, d}, job.energy_part + groups);
    reduce<1>(queue, 1, RowSum{job.energy_part, groups}, job.told + FLAGS);
    reduce<1>(queue, 1, RowSum{job.energy_part + groups, chunks}, job.told + FLAGS + 2);
    return queue.code();
}

}  // namespace dw

#if defined(_WIN32)
#define DW_API extern "C" __declspec(dllexport)
#else
#define DW_API extern "C"
#endif
#define DW_BY_SIZE(call) (size == 8 ? dw::call<double> : dw::call<float>)

// Raised whenever the layout of a struct or the meaning of an argument changes.
DW_API int32_t dw_kernels_version() { return 2; }

DW_API int32_t dw_system(const dw::Job* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_system)(*job, stream);
}
DW_API int32_t dw_finish(const dw::Job* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_finish)(*job, stream);
}
DW_API int32_t dw_move(const dw::Job* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_move)(*job, stream);
}
DW_API int32_t dw_energy(const dw::Job* job, const void* T_cw, const void* disps, void* moved,
                         int32_t size, void* stream) {
    return DW_BY_SIZE(launch_energy)(*job, T_cw, disps, moved, stream);
}
DW_API int32_t dw_frame_distance(const dw::Pairs* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_frame_distance)(*job, stream);
}
DW_API int32_t dw_confirmed_views(const dw::Pairs* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_confirmed_views)(*job, stream);
}
DW_API int32_t dw_pair_values(const dw::Consistency* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_pair_values)(*job, stream);
}
DW_API int32_t dw_pair_gradient(const dw::Consistency* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_pair_gradient)(*job, stream);
}
DW_API int32_t dw_parameter_gradient(const dw::Parameters* job, int32_t size, void* stream) {
    return DW_BY_SIZE(launch_parameter_gradient)(*job, stream);
}
