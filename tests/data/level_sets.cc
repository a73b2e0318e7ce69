// Makes level_sets.vdb and level_sets_as_fog.vdb: small level sets, and what OpenVDB's own
// tools::sdfToFogVolume makes of them. Debian 12 (OpenVDB 10.0.1):
//
//     apt-get install g++ libopenvdb-dev libboost-dev libtbb-dev libimath-dev
//     g++ -O1 -std=c++17 -I/usr/include/Imath level_sets.cc -o /tmp/level_sets -lopenvdb -ltbb -lImath-3_1
//     /tmp/level_sets tests/data

#include <openvdb/openvdb.h>
#include <openvdb/tools/LevelSetSphere.h>
#include <openvdb/tools/LevelSetUtil.h>
#include <string>

using namespace openvdb;

template <typename GridType>
typename GridType::Ptr sphere(const char* name, float radius, Vec3f centre, float width)
{
    auto grid = tools::createLevelSetSphere<GridType>(radius, centre, 1.0f, width);
    grid->setName(name);
    return grid;
}

int main(int, char** argv)
{
    initialize();
    // A tile of 8 voxels inside.
    auto tiled = sphere<FloatGrid>("tiled", 10.3f, Vec3f(4, 4, 3.6f), 2.5f);
    // Too small for a tile inside: the deepest voxel is 1.
    auto small = sphere<FloatGrid>("small", 3.4f, Vec3f(0.3f, -20.2f, 4), 3);
    // All distances inside are stored.
    auto deep = sphere<FloatGrid>("deep", 3.2f, Vec3f(-36, 4, 3.5f), 4.5f);
    // Distances in double.
    auto wide = sphere<DoubleGrid>("double", 3.1f, Vec3f(1, 2, 3), 3);
    // Nothing is inside.
    auto outside = FloatGrid::create(3);
    outside->setName("outside");
    outside->setGridClass(GRID_LEVEL_SET);
    outside->tree().setValue(Coord(1, 2, 3), 0.5f);

    GridPtrVec grids{tiled, small, deep, wide, outside};
    const std::string folder = argv[1];
    io::File(folder + "/level_sets.vdb").write(grids);
    for (auto& grid : grids) {
        if (auto f = gridPtrCast<FloatGrid>(grid)) tools::sdfToFogVolume(*f);
        if (auto d = gridPtrCast<DoubleGrid>(grid)) tools::sdfToFogVolume(*d);
    }
    io::File(folder + "/level_sets_as_fog.vdb").write(grids);
}
