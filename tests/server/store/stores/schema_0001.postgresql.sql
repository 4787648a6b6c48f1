SET statement_timeout = 0;
SET lock_timeout = 0;
SET idle_in_transaction_session_timeout = 0;
SET client_encoding = 'UTF8';
SET standard_conforming_strings = on;
SELECT pg_catalog.set_config('search_path', '', false);
SET check_function_bodies = false;
SET xmloption = content;
SET client_min_messages = warning;
SET row_security = off;
SET default_tablespace = '';
SET default_table_access_method = heap;
CREATE TABLE public.ballot_tiles (
    "row" integer NOT NULL,
    col integer NOT NULL,
    ballot bigint NOT NULL,
    base character varying(64) NOT NULL,
    states bytea,
    tally bytea,
    gone bytea,
    new_points bytea,
    free bytea
);
CREATE TABLE public.ballots (
    seq bigint NOT NULL,
    first_seq bigint NOT NULL,
    gone_seq bigint,
    vehicle character varying(64) NOT NULL,
    drive character varying(64) NOT NULL,
    digest character varying(64) NOT NULL,
    start_ns bigint NOT NULL,
    end_ns bigint NOT NULL,
    received_ns bigint NOT NULL,
    settings_hash character varying(128) NOT NULL
);
CREATE TABLE public.bars (
    version integer NOT NULL,
    "row" integer NOT NULL,
    col integer NOT NULL,
    seq bigint NOT NULL,
    cells bytea NOT NULL
);
CREATE TABLE public.blobs (
    hash character varying(64) NOT NULL,
    data bytea NOT NULL
);
CREATE TABLE public.decisions (
    version integer NOT NULL,
    "row" integer NOT NULL,
    col integer NOT NULL,
    states bytea NOT NULL,
    tally bytea NOT NULL,
    vehicles integer NOT NULL,
    added integer NOT NULL,
    deleted integer NOT NULL
);
CREATE TABLE public.events (
    seq bigint NOT NULL,
    at_ns bigint NOT NULL,
    kind character varying(16) NOT NULL,
    actor character varying(80) NOT NULL,
    detail character varying(400) NOT NULL
);
CREATE TABLE public.keys (
    name character varying(64) NOT NULL,
    role character varying(16) NOT NULL,
    hash character varying(64) NOT NULL,
    created_ns bigint NOT NULL,
    revoked_ns bigint
);
CREATE TABLE public.maps (
    map_id character varying(200) NOT NULL,
    x0 double precision NOT NULL,
    y0 double precision NOT NULL,
    georeference json NOT NULL,
    method character varying(64)
);
CREATE TABLE public.version_tiles (
    version integer NOT NULL,
    "row" integer NOT NULL,
    col integer NOT NULL,
    points character varying(64),
    ground character varying(64),
    free character varying(64)
);
CREATE TABLE public.versions (
    number integer NOT NULL,
    parent integer,
    kind character varying(16) NOT NULL,
    target integer,
    created_ns bigint NOT NULL,
    published_by character varying(80) NOT NULL,
    reason character varying(400) NOT NULL,
    mark bigint NOT NULL,
    policy json NOT NULL
);
INSERT INTO public.ballot_tiles VALUES (0, 0, 2, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd6000ffb5000018ff03020400df61a08381807f066a10f499817c2004', NULL, '\x28b52ffda0000008009c000010001e03005d5f200726680a62fb31413b6003020010000200100003001000', '\x28b52ffd2018c10000cdccc440cdccc4406666e63ecdccc440cdccc4400000403f', '\x28b52ffda000000800a400001800f00f03001c0e7ac00ea7870f1dd9e13a6003020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 3, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd6000ffb5000018ff03020400df61a08381807f066a10f499817c2004', NULL, '\x28b52ffda0000008009c000010001e03005d5f200726680a62fb31413b6003020010000200100003001000', '\x28b52ffd2018c10000cdccc440cdccc4406666e63ecdccc440cdccc4400000403f', '\x28b52ffda000000800a400001800f00f03001c0e7ac00ea7870f1dd9e13a6003020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 4, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd6000ff8d000010ff000300e86ba0c3811c04fd33900fd8', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 7, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd6000ff95000010ff020300ad2fa003095a41953f12c40336', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000', '\x28b52ffd2018c1000066664241666642416666e63e66664241666642410000403f', '\x28b52ffda000000800d4000048000600000000000080030006063ea0c70be487cef4781db001020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 8, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd6000ff95000010ff020300ad2fa003095a41953f12c40336', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000', '\x28b52ffd2018c1000066664241666642416666e63e66664241666642410000403f', '\x28b52ffda000000800d4000048000600000000000080030006063ea0c70be487cef4781db001020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 9, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd6000ffad000018ff02ff0400d355d0e18060a9600e2824413c6003', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000', '\x28b52ffd2030150100b066664241e63e0000403f333347416666e63e0000403f04002e1137f017820d9708', '\x28b52ffda000000800d4000048000600000000000080030006063ea0c70be487cef4781db001020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 12, 'b701c2cfd7fba4b9bbd3661c52b5f5dee49e1a89282dcb617ce23bcd2762bede', '\x28b52ffd6000ff8d000010ff030300e46ba043822004fd43900fd8', NULL, '\x28b52ffda0000008009c000010001e03003d5f20072e680c62fb71413b6003020010000200100003001000', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000');
INSERT INTO public.ballot_tiles VALUES (0, 0, 13, 'b701c2cfd7fba4b9bbd3661c52b5f5dee49e1a89282dcb617ce23bcd2762bede', '\x28b52ffd6000ff8d000010ff030300e46ba043822004fd43900fd8', NULL, '\x28b52ffda0000008009c000010001e03003d5f20072e680c62fb71413b6003020010000200100003001000', NULL, '\x28b52ffda0000008004c000008000100fcff391002020010000200100003001000');
INSERT INTO public.ballots VALUES (2, 2, NULL, 'v1', 'd1', '0b4e9a1340ad267a86ede6af1cab141eda862864c5804773d9f220c2e1e97cee', 1700000002000000000, 1700000003000000000, 1700000005000000000, 's');
INSERT INTO public.ballots VALUES (3, 3, NULL, 'v2', 'd1', '64eacf7182163f524b59df13bd47419899a385388c683feddac72e982af58c52', 1700000005000000000, 1700000006000000000, 1700000008000000000, 's');
INSERT INTO public.ballots VALUES (7, 7, NULL, 'v3', 'd1', '4f961c495b3f1ab6e309cc38e2e32001a71b3435bd0ab32fcacc7be5854145d0', 1700000014000000000, 1700000015000000000, 1700000017000000000, 's');
INSERT INTO public.ballots VALUES (9, 8, NULL, 'v4', 'd1', 'fc00c44bafa070cbe7ed10f8111c18ba7ccf1578c331a3df92287ea96b238e6a', 1700000020000000000, 1700000021000000000, 1700000023000000000, 's');
INSERT INTO public.ballots VALUES (8, 8, 9, 'v4', 'd1', 'a89395a8c525f8d752419fa8b6c98f04be963f0a216361d63812f92677af47c7', 1700000017000000000, 1700000018000000000, 1700000020000000000, 's');
INSERT INTO public.ballots VALUES (4, 4, 10, 'v5', 'd1', '0b5a835d08762fa44e6091b085e37e3761a1693f2ce0b04f0ceea94cb434bf81', 1700000008000000000, 1700000009000000000, 1700000011000000000, 's');
INSERT INTO public.ballots VALUES (12, 12, NULL, 'v3', 'd2', '2e3e17f9d0eae37058951bc251338bd77e674a4958a23a73624f3d6ae5aeeebe', 1700000026000000000, 1700000027000000000, 1700000029000000000, 's');
INSERT INTO public.ballots VALUES (13, 13, NULL, 'v4', 'd2', 'a0e070d7b7a171be71509be3d4744fa40908e54f545e5bc3d84906ac050cd201', 1700000029000000000, 1700000030000000000, 1700000032000000000, 's');
INSERT INTO public.bars VALUES (3, 0, 0, 6, '\x28b52ffd60001f8d0000300000200008000350020079ddf3a83c6a');
INSERT INTO public.blobs VALUES ('03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '\x28b52ffd209045020024029a9949409a994940cdcc4c3dcdcc5c0000706666e63e0000403f6666863f6666863f11008000047821800057200001000108f0427054005f110208014420602500508617a50e');
INSERT INTO public.blobs VALUES ('8a39d2abd3999ab73c34db2476849cddf303ce389b35826850f9a700589b4a90', '\x28b52ffda0000004005400001000000100fbff39c00203001000');
INSERT INTO public.blobs VALUES ('f00dc56ece99fbf72615933cbf00efcc2ae862f701766feed7716f76fe8edb5b', '\x28b52ffd20843d020064029a9949409a994940cdcc4c3dcdcc5c0000706666e63e0000403f6666863fcdccc4400000403f0e002f0420c02e0804000420c00bc151014c450820e485d04e0240195e943a');
INSERT INTO public.blobs VALUES ('8445b2444d2804ebe8ea5d4044de8c9db32cf7120529ccb6eec770f3e83a0e9e', '\x28b52ffda0000008008c0000280000f00f0002000a0f201feb701d6001020010000200100003001000');
INSERT INTO public.blobs VALUES ('b701c2cfd7fba4b9bbd3661c52b5f5dee49e1a89282dcb617ce23bcd2762bede', '\x28b52ffd20a8a5020084029a9949409a994940cdcc4c3dcdcc5c0000706666e63e0000403f6666863f66664241e63e0000403f14002f04ef864000400002bc1040802b1080008000047821382a80af080184002210b0120028c38b5207');
INSERT INTO public.blobs VALUES ('4744c7d4097dc2dc611b9b83adcd59127077a22888c8bced7699640d83e16a50', '\x28b52ffda000000800c40000480000f00f0006008000041000fc06190b5800fe5887eb58020010000200100003001000');
INSERT INTO public.decisions VALUES (2, 0, 0, '\x28b52ffd6000ff95000030ffff03ff02ff03500200e76bbd407e81fc', '\x28b52ffd804800000a007c000020000010000200e7eb20c70fd4032c02001000740000180020000200d3d7204712c40336740000180020000200e7eb204708ea011b03001000', 3, 2, 3);
INSERT INTO public.decisions VALUES (4, 0, 0, '\x28b52ffd6000ff95000030ffff02ff04ff03500200d2569d4f8d203e', '\x28b52ffd804800000a005400001000000100fbff39c00202001000940000280020001000031000a9ad39ee579109dad90200100003001000', 4, 2, 0);
INSERT INTO public.events VALUES (1, 1700000001000000000, 'import', 'operator', 'test-map');
INSERT INTO public.events VALUES (2, 1700000005000000000, 'ballot', 'v1', 'd1');
INSERT INTO public.events VALUES (3, 1700000008000000000, 'ballot', 'v2', 'd1');
INSERT INTO public.events VALUES (4, 1700000011000000000, 'ballot', 'v5', 'd1');
INSERT INTO public.events VALUES (5, 1700000013000000000, 'publish', 'ann', 'v2');
INSERT INTO public.events VALUES (6, 1700000014000000000, 'rollback', 'ann', 'v3');
INSERT INTO public.events VALUES (7, 1700000017000000000, 'ballot', 'v3', 'd1');
INSERT INTO public.events VALUES (8, 1700000020000000000, 'ballot', 'v4', 'd1');
INSERT INTO public.events VALUES (9, 1700000023000000000, 'ballot', 'v4', 'd1');
INSERT INTO public.events VALUES (10, 1700000024000000000, 'withdraw', 'ann', 'v5/*');
INSERT INTO public.events VALUES (11, 1700000026000000000, 'publish', 'ann', 'v4');
INSERT INTO public.events VALUES (12, 1700000029000000000, 'ballot', 'v3', 'd2');
INSERT INTO public.events VALUES (13, 1700000032000000000, 'ballot', 'v4', 'd2');
INSERT INTO public.events VALUES (14, 1700000033000000000, 'key issued', 'operator', 'operator ann');
INSERT INTO public.events VALUES (15, 1700000034000000000, 'key issued', 'operator', 'vehicle v1');
INSERT INTO public.events VALUES (16, 1700000035000000000, 'key revoked', 'operator', 'v1');
INSERT INTO public.keys VALUES ('ann', 'operator', '3009e5d48d512e7f254ec72b2eebe863b3c9dcbddbf7459453121787616b381c', 1700000033000000000, NULL);
INSERT INTO public.keys VALUES ('v1', 'vehicle', '9e517cd615006749a917bc903a5a7ad1bd0a1787a20649af34c7be94a47cb4c6', 1700000034000000000, 1700000035000000000);
INSERT INTO public.maps VALUES ('test-map', 0, 0, '{}', 'columns, two-stage');
INSERT INTO public.version_tiles VALUES (1, 0, 0, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '8a39d2abd3999ab73c34db2476849cddf303ce389b35826850f9a700589b4a90', NULL);
INSERT INTO public.version_tiles VALUES (1, 0, 1, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '8a39d2abd3999ab73c34db2476849cddf303ce389b35826850f9a700589b4a90', NULL);
INSERT INTO public.version_tiles VALUES (2, 0, 0, 'f00dc56ece99fbf72615933cbf00efcc2ae862f701766feed7716f76fe8edb5b', '8a39d2abd3999ab73c34db2476849cddf303ce389b35826850f9a700589b4a90', '8445b2444d2804ebe8ea5d4044de8c9db32cf7120529ccb6eec770f3e83a0e9e');
INSERT INTO public.version_tiles VALUES (3, 0, 0, '03d41a5171eb516db6808d8a6a68cf307e40b9aecc6b61a224def51152ca8efd', '8a39d2abd3999ab73c34db2476849cddf303ce389b35826850f9a700589b4a90', NULL);
INSERT INTO public.version_tiles VALUES (4, 0, 0, 'b701c2cfd7fba4b9bbd3661c52b5f5dee49e1a89282dcb617ce23bcd2762bede', '8a39d2abd3999ab73c34db2476849cddf303ce389b35826850f9a700589b4a90', '4744c7d4097dc2dc611b9b83adcd59127077a22888c8bced7699640d83e16a50');
INSERT INTO public.versions VALUES (1, NULL, 'import', NULL, 1700000002000000000, 'operator', 'first map', 1, '{}');
INSERT INTO public.versions VALUES (2, 1, 'publish', NULL, 1700000013000000000, 'ann', 'first round', 4, '{"min_votes": 2, "latest_vehicles": 9, "max_age_days": 30.0, "min_age_s": 0.0, "max_deleted_share": 0.5}');
INSERT INTO public.versions VALUES (3, 2, 'rollback', 1, 1700000014000000000, 'ann', 'the wall stands', 6, '{}');
INSERT INTO public.versions VALUES (4, 3, 'publish', NULL, 1700000026000000000, 'ann', '', 10, '{"min_votes": 2, "latest_vehicles": 9, "max_age_days": 30.0, "min_age_s": 0.0, "max_deleted_share": 0.5}');
ALTER TABLE ONLY public.ballot_tiles
    ADD CONSTRAINT pk_ballot_tiles PRIMARY KEY ("row", col, ballot);
ALTER TABLE ONLY public.ballots
    ADD CONSTRAINT pk_ballots PRIMARY KEY (seq);
ALTER TABLE ONLY public.bars
    ADD CONSTRAINT pk_bars PRIMARY KEY (version, "row", col);
ALTER TABLE ONLY public.blobs
    ADD CONSTRAINT pk_blobs PRIMARY KEY (hash);
ALTER TABLE ONLY public.decisions
    ADD CONSTRAINT pk_decisions PRIMARY KEY (version, "row", col);
ALTER TABLE ONLY public.events
    ADD CONSTRAINT pk_events PRIMARY KEY (seq);
ALTER TABLE ONLY public.keys
    ADD CONSTRAINT pk_keys PRIMARY KEY (name, role, hash);
ALTER TABLE ONLY public.maps
    ADD CONSTRAINT pk_maps PRIMARY KEY (map_id);
ALTER TABLE ONLY public.version_tiles
    ADD CONSTRAINT pk_version_tiles PRIMARY KEY (version, "row", col);
ALTER TABLE ONLY public.versions
    ADD CONSTRAINT pk_versions PRIMARY KEY (number);
ALTER TABLE ONLY public.keys
    ADD CONSTRAINT uq_keys_hash UNIQUE (hash);
CREATE INDEX ix_ballot_tiles_ballot ON public.ballot_tiles USING btree (ballot);
CREATE INDEX ix_ballots_drive ON public.ballots USING btree (vehicle, drive);
CREATE INDEX ix_version_tiles_tile ON public.version_tiles USING btree ("row", col, version);
ALTER TABLE ONLY public.ballot_tiles
    ADD CONSTRAINT fk_ballot_tiles_ballot_ballots FOREIGN KEY (ballot) REFERENCES public.ballots(seq);
ALTER TABLE ONLY public.ballots
    ADD CONSTRAINT fk_ballots_seq_events FOREIGN KEY (seq) REFERENCES public.events(seq);
ALTER TABLE ONLY public.bars
    ADD CONSTRAINT fk_bars_version_versions FOREIGN KEY (version) REFERENCES public.versions(number);
ALTER TABLE ONLY public.decisions
    ADD CONSTRAINT fk_decisions_version_versions FOREIGN KEY (version) REFERENCES public.versions(number);
ALTER TABLE ONLY public.version_tiles
    ADD CONSTRAINT fk_version_tiles_version_versions FOREIGN KEY (version) REFERENCES public.versions(number);
